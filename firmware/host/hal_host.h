// A virtual board in virtual time: an event simulation behind the functions of hal.h, with motors, switches, a camera
// and a memory. One thread; "interrupts" run inside hal::idle() and whenever the main program has spent time.
#pragma once
#include <stdint.h>

#include <deque>
#include <functional>
#include <vector>

#include "../uvgs_gantry/src/hal.h"

namespace virtual_board {

using Ticks = uint64_t;

// Thrown out of the main program when the board is reset by its button or power.
struct HardReset {
  uvgs::hal::ResetCause cause;
};

struct StepEvent {
  Ticks t;
  uint8_t axes, negative;
};

struct Board {
  Ticks now = 0;            // since the board was made
  Ticks started = 0;        // when its clock was last reset
  Ticks limit = 0;          // at this time `at_limit` is called, which must raise it or throw
  std::function<void()> at_limit;
  std::function<void(const StepEvent&)> on_step;

  // What stands on the table: counted from the pins, never told by the firmware.
  int64_t motor[uvgs::AXES] = {0, 0, 0};
  int64_t switch_at[uvgs::AXES] = {3000, 2000, 1000};  // closed at and beyond
  bool has_switch[uvgs::AXES] = {true, true, true};
  uint8_t direction_levels = 0;
  bool motor_level = false, estop_level = false;
  uint8_t led_duty = 0;
  std::vector<Ticks> trigger_pulses;
  uint8_t strobe_edge = 0;
  bool strobe_level = false;
  std::vector<uint8_t> memory = std::vector<uint8_t>(1024, 0xFF);
  uint64_t memory_writes = 0;

  // The serial line, one byte per 87 us each way.
  struct Sent { Ticks t; uint8_t byte; };
  std::deque<Sent> to_host;
  std::deque<Sent> from_host;
  uvgs::hal::ResetCause cause = uvgs::hal::ResetCause::power;
  bool feeds_watchdog = true;

  void receive(uint8_t byte, Ticks at);
  void strobe();
  void set_estop(bool level);
  // Take a mechanical turn at the motor behind the firmware's back.
  void shove(uint8_t axis, int64_t steps);
};

extern Board board;

constexpr Ticks BYTE_TICKS = 174;

// Run the firmware from its reset; returns when `at_limit` throws something that is not a HardReset.
void power_up();

}  // namespace virtual_board
