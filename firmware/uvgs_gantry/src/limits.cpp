#include "limits.h"

#include <math.h>

#include "machine.h"
#include "planner.h"
#include "serial.h"
#include "settings.h"
#include "stepper.h"

namespace uvgs {
namespace limits {
namespace {

constexpr float SEARCH = 1.5f;           // times the travel
constexpr float LOCATE_PULL_OFFS = 5.0f;
constexpr uint8_t CLEARING_TRIES = 5;
constexpr uint8_t NO_SWITCH = 9, STILL_CLOSED = 8, BROKEN_OFF = 0xFF;

Edge edges[AXES];
int32_t shift[AXES];
volatile uint8_t was_closed;
volatile uint8_t homed_axes;

bool has_negative_switch(uint8_t axis) { return settings::now.homing_negative & (1 << axis); }

// Wait while the machine serves everything else; false when a reset came.
bool wait_ms(uint16_t ms) {
  uint32_t begun = hal::ticks();
  while (hal::ticks() - begun < ms * TICKS_PER_MS) {
    machine::service(true);
    if (machine::is_aborted()) return false;
  }
  return true;
}

// Move axes of a group, each by so many mm towards its switch (or away), and wait.
bool move(uint8_t axes, float mm, bool towards, float mm_min, bool until_closed) {
  int32_t from[AXES], to[AXES];
  stepper::positions(from);
  float count = 0.0f;
  for (uint8_t i = 0; i < AXES; ++i) {
    to[i] = from[i];
    if (!(axes & (1 << i))) continue;
    float sense = has_negative_switch(i) == towards ? -1.0f : 1.0f;
    to[i] += static_cast<int32_t>(lroundf(sense * mm * settings::now.steps_per_mm[i]));
    count += 1.0f;
  }
  stepper::lock_on_limit(until_closed ? axes : 0);
  if (until_closed) {
    hal::Quiet quiet;
    on_change();
    stepper::lock(closed() & axes);
  }
  planner::add(from, to, mm_min / 60.0f * sqrtf(count));
  bool is_found = false;
  while (!machine::is_aborted()) {
    machine::service(false);
    is_found = until_closed && stepper::locked() == axes;
    if (is_found || (planner::is_empty() && !stepper::is_moving())) break;
  }
  stepper::kill();
  stepper::lock_on_limit(0);
  stepper::discard();
  planner::clear();
  return is_found;
}

uint8_t home_group(uint8_t axes) {
  float search = 0.0f;
  for (uint8_t i = 0; i < AXES; ++i) {
    if (!(axes & (1 << i))) continue;
    float reach = SEARCH * settings::now.travel_mm[i];
    search = search == 0.0f || reach < search ? reach : search;
  }
  const float pull_off = settings::now.pull_off_mm, seek = settings::now.seek_mm_min;
  // A switch that is closed before the start is left first, so that what counts is always a closing edge.
  for (uint8_t i = 0; i < CLEARING_TRIES && (closed() & axes); ++i) {
    move(closed() & axes, pull_off, false, seek, false);
    if (!wait_ms(settings::now.debounce_ms)) return BROKEN_OFF;
  }
  for (uint8_t pass = 0; pass < 2; ++pass) {
    bool is_found = pass == 0 ? move(axes, search, true, seek, true)
                              : move(axes, LOCATE_PULL_OFFS * pull_off, true, settings::now.locate_mm_min, true);
    if (machine::is_aborted()) return BROKEN_OFF;
    if (!is_found) return NO_SWITCH;
    if (!wait_ms(settings::now.debounce_ms)) return BROKEN_OFF;
    move(axes, pull_off, false, seek, false);
    if (machine::is_aborted() || !wait_ms(settings::now.debounce_ms)) return BROKEN_OFF;
    if (closed() & axes) return STILL_CLOSED;
  }
  return 0;
}

}  // namespace

void init() {
  hal::Quiet quiet;
  for (uint8_t i = 0; i < AXES; ++i) {
    edges[i] = Edge{0, Instant{0, 0}, 0};
    shift[i] = 0;
  }
  was_closed = closed();
  homed_axes = 0;
}

uint8_t closed() {
  // Pins are pulled up and closed switches pull them down, unless $5 says otherwise.
  uint8_t levels = hal::limit_levels();
  return settings::now.limit_invert ? levels & ALL_AXES : ~levels & ALL_AXES;
}

bool is_estop_pressed() {
  if (settings::now.estop == 0) return false;
  return hal::estop_level() == (settings::now.estop == 1);
}

uint8_t homed() { return homed_axes; }

void forget_homed() { homed_axes = 0; }

uint8_t with_switch() {
  uint8_t axes = 0;
  for (uint8_t i = 0; i < AXES; ++i)
    if (settings::now.travel_mm[i] > 0.0f) axes |= static_cast<uint8_t>(1 << i);
  return axes;
}

bool may_move() { return !settings::now.homing || !settings::now.need_homing || homed_axes == ALL_AXES; }

uint8_t run_homing() {
  homed_axes = 0;
  const uint8_t groups[2] = {1 << 2, (1 << 0) | (1 << 1)};
  for (uint8_t i = 0; i < 2; ++i) {
    uint8_t axes = groups[i] & with_switch();
    if (axes == 0) continue;
    uint8_t alarm = home_group(axes);
    if (alarm != 0) return alarm;
  }
  int32_t before[AXES], after[AXES];
  stepper::positions(before);
  for (uint8_t i = 0; i < AXES; ++i) {
    float mm = 0.0f;
    if (with_switch() & (1 << i)) {
      mm = has_negative_switch(i) ? settings::now.pull_off_mm - settings::now.travel_mm[i] : -settings::now.pull_off_mm;
    }
    after[i] = static_cast<int32_t>(lroundf(mm * settings::now.steps_per_mm[i]));
    shift[i] = after[i] - before[i];
    hal::Quiet quiet;
    edges[i].steps += shift[i];
  }
  stepper::set_positions(after);
  homed_axes = ALL_AXES;
  return 0;
}

void print_edges() {
  for (uint8_t i = 0; i < AXES; ++i) {
    Edge edge;
    {
      hal::Quiet quiet;
      edge = edges[i];
    }
    serial::begin_checked(UVGS_TEXT("EDGE"));
    serial::put(static_cast<char>('X' + i));
    serial::put('|');
    serial::number(edge.steps);
    serial::put('|');
    serial::microseconds(edge.instant);
    serial::put('|');
    serial::unsigned_number(edge.count);
    serial::end_checked();
  }
  serial::begin_checked(UVGS_TEXT("SHIFT"));
  for (uint8_t i = 0; i < AXES; ++i) {
    if (i > 0) serial::put(',');
    serial::number(shift[i]);
  }
  serial::end_checked();
}

void on_change() {
  uint8_t now_closed = closed();
  uint8_t closing = now_closed & static_cast<uint8_t>(~was_closed);
  was_closed = now_closed;
  for (uint8_t i = 0; i < AXES; ++i) {
    if (!(closing & (1 << i))) continue;
    edges[i].steps = stepper::position_in_interrupt(i);
    edges[i].instant = hal::now();
    ++edges[i].count;
  }
  stepper::lock(closing & stepper::lock_mask_in_interrupt());
  if (closing != 0 && settings::now.hard_limits) machine::on_hard_limit();
  if (is_estop_pressed()) machine::on_estop();
}

}  // namespace limits
}  // namespace uvgs
