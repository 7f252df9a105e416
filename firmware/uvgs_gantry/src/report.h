// What is told about positions: GRBL's report <...> and the exact one [POS:...].
#pragma once
#include "hal.h"

namespace uvgs {
namespace report {

// Everything of one instant, taken by the receive interrupt.
struct Snapshot {
  Instant instant;
  int32_t position[AXES];
  Instant rested_since;
  bool is_moving;
};

void clear();
void take_snapshot(Snapshot& snapshot);  // interrupts off
void status();
void exact(const char* name_in_flash, const Snapshot& snapshot);
// Put the overrides into the next status report, as GRBL does after a change of the spindle.
void tell_overrides_next();
void state_word();
void modes();

}  // namespace report
}  // namespace uvgs
