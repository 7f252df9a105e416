// Limit switches, the emergency stop and the homing cycle.
#pragma once
#include "hal.h"

namespace uvgs {
namespace limits {

// The last closing edge of a switch: where and when.
struct Edge {
  int32_t steps;
  Instant instant;
  uint16_t count;
};

void init();
uint8_t closed();            // bit per axis
bool is_estop_pressed();
uint8_t homed();             // bit per axis
void forget_homed();
// Axes with a switch: those with a travel.
uint8_t with_switch();
bool may_move();             // whether $22 and $201 let moves happen
// The whole cycle. Returns 0, an alarm number, or 0xFF when a reset broke it off.
uint8_t run_homing();
void print_edges();

void on_change();            // interrupt: a limit or emergency-stop pin changed

}  // namespace limits
}  // namespace uvgs
