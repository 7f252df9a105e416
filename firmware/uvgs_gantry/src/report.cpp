#include "report.h"

#include "limits.h"
#include "machine.h"
#include "planner.h"
#include "serial.h"
#include "settings.h"
#include "stepper.h"
#include "trigger.h"

namespace uvgs {
namespace report {
namespace {

using machine::State;

// Offsets (always zero) and overrides (always 100 %) are told every so many reports, as GRBL does.
constexpr uint8_t OFFSETS_EVERY = 10, OVERRIDES_EVERY = 10, OFFSETS_EVERY_BUSY = 30, OVERRIDES_EVERY_BUSY = 20;
uint8_t until_offsets, until_overrides;
uint16_t sequence;

void axis_letters(uint8_t axes) {
  for (uint8_t i = 0; i < AXES; ++i)
    if (axes & (1 << i)) serial::put(static_cast<char>('X' + i));
}

int32_t rpm_now() {
  const gcode::Modal& modal = machine::modal();
  return modal.spindle == 5 ? 0 : static_cast<int32_t>(modal.rpm + 0.5f);
}

uint32_t age_us(const Snapshot& s) {
  if (s.is_moving) return 0;
  // Half a tick count; an age of more than 35 minutes is told as that.
  uint32_t high = s.instant.high - s.rested_since.high;
  if (high > 0xFFFF) return 0x7FFFFFFF;
  return (s.instant.ticks() - s.rested_since.ticks()) >> 1;
}

}  // namespace

void clear() {
  until_offsets = 0;
  until_overrides = 0;
}

void tell_overrides_next() { until_overrides = 0; }

void take_snapshot(Snapshot& s) {
  s.instant = hal::now();
  for (uint8_t i = 0; i < AXES; ++i) s.position[i] = stepper::position_in_interrupt(i);
  s.rested_since = stepper::rested_since();
  s.is_moving = stepper::is_moving_in_interrupt();
}

void state_word() {
  switch (machine::state()) {
    case State::idle: serial::text(UVGS_TEXT("Idle")); break;
    case State::run: serial::text(UVGS_TEXT("Run")); break;
    case State::hold: serial::text(stepper::has_stopped() ? UVGS_TEXT("Hold:0") : UVGS_TEXT("Hold:1")); break;
    case State::jog: serial::text(UVGS_TEXT("Jog")); break;
    case State::alarm: serial::text(UVGS_TEXT("Alarm")); break;
    case State::check: serial::text(UVGS_TEXT("Check")); break;
    case State::home: serial::text(UVGS_TEXT("Home")); break;
    default: serial::text(UVGS_TEXT("Sleep"));
  }
}

void status() {
  int32_t steps[AXES];
  stepper::positions(steps);
  serial::put('<');
  state_word();
  serial::text(settings::now.report_mask & 1 ? UVGS_TEXT("|MPos:") : UVGS_TEXT("|WPos:"));
  for (uint8_t i = 0; i < AXES; ++i) {
    if (i > 0) serial::put(',');
    serial::fixed3(static_cast<float>(steps[i]) / settings::now.steps_per_mm[i]);
  }
  if (settings::now.report_mask & 2) {
    serial::text(UVGS_TEXT("|Bf:"));
    serial::unsigned_number(planner::free_blocks());
    serial::put(',');
    serial::unsigned_number(serial::rx_free());
  }
  serial::text(UVGS_TEXT("|FS:"));
  serial::unsigned_number(static_cast<uint32_t>(stepper::speed_mm_s() * 60.0f));
  serial::put(',');
  serial::number(rpm_now());
  if (limits::closed()) {
    serial::text(UVGS_TEXT("|Pn:"));
    axis_letters(limits::closed());
  }
  State state = machine::state();
  bool is_busy = state == State::run || state == State::jog || state == State::home || state == State::hold;
  if (until_offsets > 0) {
    --until_offsets;
  } else {
    until_offsets = (is_busy ? OFFSETS_EVERY_BUSY : OFFSETS_EVERY) - 1;
    if (until_overrides == 0) until_overrides = 1;
    serial::text(UVGS_TEXT("|WCO:0.000,0.000,0.000"));
  }
  if (until_overrides > 0) {
    --until_overrides;
  } else {
    until_overrides = (is_busy ? OVERRIDES_EVERY_BUSY : OVERRIDES_EVERY) - 1;
    serial::text(UVGS_TEXT("|Ov:100,100,100"));
    const gcode::Modal& modal = machine::modal();
    if (modal.spindle != 5 || modal.coolant == 8) serial::text(UVGS_TEXT("|A:"));
    if (modal.spindle != 5) serial::put(modal.spindle == 3 ? 'S' : 'C');
    if (modal.coolant == 8) serial::put('F');
  }
  serial::put('>');
  serial::end_line();
}

void exact(const char* name_in_flash, const Snapshot& s) {
  serial::begin_checked(name_in_flash);
  serial::unsigned_number(sequence++);
  serial::put('|');
  state_word();
  serial::put('|');
  serial::microseconds(s.instant);
  for (uint8_t i = 0; i < AXES; ++i) {
    serial::put(i == 0 ? '|' : ',');
    serial::number(s.position[i]);
  }
  serial::put('|');
  serial::unsigned_number(age_us(s));
  serial::put('|');
  uint8_t closed = limits::closed();
  bool is_stopped = limits::is_estop_pressed();
  axis_letters(closed);
  if (is_stopped) serial::put('E');
  if (closed == 0 && !is_stopped) serial::put('-');
  serial::put('|');
  axis_letters(limits::homed());
  if (limits::homed() == 0) serial::put('-');
  serial::put('|');
  bool is_writing = settings::is_writing(), has_lost = trigger::has_lost();
  if (s.is_moving) serial::put('M');
  if (is_writing) serial::put('W');
  if (has_lost) serial::put('O');
  bool ran_dry = stepper::underruns() > 0, dropped = serial::rx_lost() > 0;
  if (ran_dry) serial::put('U');
  if (dropped) serial::put('B');
  if (!s.is_moving && !is_writing && !has_lost && !ran_dry && !dropped) serial::put('-');
  serial::put('|');
  serial::unsigned_number(settings::boot_number());
  serial::end_checked();
}

void modes() {
  const gcode::Modal& modal = machine::modal();
  serial::text(UVGS_TEXT("[GC:G"));
  serial::unsigned_number(modal.motion);
  serial::text(modal.is_inch ? UVGS_TEXT(" G54 G17 G20 G9") : UVGS_TEXT(" G54 G17 G21 G9"));
  serial::put(modal.is_relative ? '1' : '0');
  serial::text(UVGS_TEXT(" G94 M"));
  serial::unsigned_number(modal.spindle);
  serial::text(UVGS_TEXT(" M"));
  serial::unsigned_number(modal.coolant);
  serial::text(UVGS_TEXT(" T"));
  serial::unsigned_number(modal.tool);
  serial::text(UVGS_TEXT(" F"));
  serial::unsigned_number(static_cast<uint32_t>(modal.feed / (modal.is_inch ? 25.4f : 1.0f) + 0.5f));
  serial::text(UVGS_TEXT(" S"));
  serial::unsigned_number(static_cast<uint32_t>(modal.rpm + 0.5f));
  serial::put(']');
  serial::end_line();
}

}  // namespace report
}  // namespace uvgs
