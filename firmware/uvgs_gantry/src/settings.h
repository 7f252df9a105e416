// The numbered settings: one struct, one table, two copies with a CRC in memory that outlives power.
#pragma once
#include "hal.h"

namespace uvgs {

struct Settings {
  float steps_per_mm[AXES], max_mm_min[AXES], max_mm_s2[AXES], travel_mm[AXES], approach_mm[AXES];
  float junction_mm, arc_mm, locate_mm_min, seek_mm_min, pull_off_mm;
  uint16_t debounce_ms, rpm_max, rpm_min, heartbeat_ms, trigger_us, settle_ms;
  uint8_t pulse_us, motor_idle_ms, step_invert, direction_invert, enable_invert, limit_invert, probe_invert;
  uint8_t report_mask, inches, soft_limits, hard_limits, homing, homing_negative, laser;
  uint8_t push_done, need_homing, estop, strobe_edge;
};

namespace settings {

extern Settings now;

// Reads the newer copy that is whole and counts this start; false when there was none and the defaults are used.
bool load();
uint16_t boot_number();
// Sets one; 0 or the number of the error. Nothing is checked against motion: that is the caller's work.
uint8_t set(uint16_t number, float value);
void restore_defaults();
// Prints $0..$132, or $200.. when extended.
void print_all(bool extended);
bool is_writing();
// Interrupt: the next byte that differs from the memory. `again`: none of the few looked at, ask again soon.
enum class Write : uint8_t { done, again, byte };
Write next_to_write(uint16_t& address, uint8_t& value);

}  // namespace settings
}  // namespace uvgs
