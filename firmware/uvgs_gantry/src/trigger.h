// The camera trigger, the strobe, and the ring of stamps they leave.
#pragma once
#include "hal.h"

namespace uvgs {
namespace trigger {

void init();
void disarm();
// One pulse when the counter of an axis becomes `at`, and then every `every` steps (0: once).
void arm(uint8_t axis, int32_t at, int32_t every);
void fire();
// Prints and removes the stamps.
void print_stamps();
bool has_lost();

// Interrupts: after the counters were updated, with the axes that stepped and those of them that went backwards.
void on_steps(uint8_t axes, uint8_t negative);
void on_strobe(Instant instant);

}  // namespace trigger
}  // namespace uvgs
