#include "commands.h"

#include <math.h>

#include "gcode.h"
#include "limits.h"
#include "machine.h"
#include "planner.h"
#include "report.h"
#include "serial.h"
#include "settings.h"
#include "stepper.h"
#include "trigger.h"

namespace uvgs {
namespace commands {
namespace {

using machine::State;

constexpr uint8_t OK = 0, BAD_NUMBER = 2, BAD_COMMAND = 3, NO_HOMING = 5, NOT_IDLE = 8, LOCKED = 9, TOO_LONG = 11,
                  BEYOND_TRAVEL = 15, BAD_TARGET = 33, NOT_HOMED = 46, ESTOP = 50, BAD_CHECKSUM = 60, BAD_SEQUENCE = 61,
                  BROKEN_OFF = 62;
constexpr uint8_t ALARM_SOFT_LIMIT = 2;
constexpr float MOST_STEPS = 1e9f;

bool has_number;
uint32_t last_number;
uint8_t last_code;

void print_line(const char* in_flash) {
  serial::text(in_flash);
  serial::end_line();
}

bool is_text(const char* text, const char* in_flash) {
  for (;; ++text, ++in_flash) {
    char c = static_cast<char>(hal::flash_byte(in_flash));
    if (*text != c) return false;
    if (c == '\0') return true;
  }
}

bool read_integer(const char*& text, int32_t& value) {
  bool is_negative = *text == '-';
  if (is_negative) ++text;
  if (*text < '0' || *text > '9') return false;
  uint32_t digits = 0;
  for (; *text >= '0' && *text <= '9'; ++text) {
    digits = digits * 10 + static_cast<uint8_t>(*text - '0');
    if (digits > 1000000000u) return false;
  }
  value = is_negative ? -static_cast<int32_t>(digits) : static_cast<int32_t>(digits);
  return true;
}

void wait_for_rest() {
  while (!machine::is_aborted() && (!planner::is_empty() || stepper::is_moving())) machine::service(false);
}

void wait_ms(float ms) {
  uint32_t begun = hal::ticks(), last = begun;
  float waited = 0.0f;
  while (!machine::is_aborted() && waited < ms) {
    machine::service(true);
    uint32_t now = hal::ticks();
    waited += static_cast<float>(now - last) / static_cast<float>(TICKS_PER_MS);
    last = now;
  }
}

uint8_t check_target(const float mm[AXES]) {
  if (limits::is_estop_pressed()) return ESTOP;
  if (!limits::may_move()) return NOT_HOMED;
  for (uint8_t i = 0; i < AXES; ++i)
    if (!(fabsf(mm[i]) * settings::now.steps_per_mm[i] < MOST_STEPS)) return BAD_TARGET;
  return OK;
}

bool is_beyond_travel(const float mm[AXES]) {
  if (!settings::now.soft_limits) return false;
  for (uint8_t i = 0; i < AXES; ++i) {
    float travel = settings::now.travel_mm[i], slack = 0.5f / settings::now.steps_per_mm[i];
    if (travel > 0.0f && (mm[i] > slack || mm[i] < -travel - slack)) return true;
  }
  return false;
}

// --- G-code ---------------------------------------------------------------------------------------------------------

uint8_t run_gcode(const char* text) {
  float position[AXES];
  machine::target_position(position);
  gcode::Action action;
  uint8_t error = gcode::read(text, machine::modal(), position, false, action);
  if (error != OK) return error;
  bool is_check = machine::state() == State::check;
  if (action.has_target && !is_check) {
    error = check_target(action.target_mm);
    if (error != OK) return error;
  }
  const gcode::Modal& before = machine::modal();
  if (action.modal.spindle != before.spindle || (action.modal.spindle != 5 && action.modal.rpm != before.rpm)) {
    // The light changes where the line says so, not while earlier moves run.
    if (!is_check) {
      wait_for_rest();
      if (machine::is_aborted()) return NO_ANSWER;
      machine::set_led(action.modal);
    }
    report::tell_overrides_next();
  }
  machine::modal() = action.modal;
  if (is_check) return OK;
  if (action.has_dwell) {
    wait_for_rest();
    wait_ms(action.dwell_s * 1000.0f);
  }
  if (!action.has_target) return OK;
  if (is_beyond_travel(action.target_mm)) {
    machine::critical_alarm(ALARM_SOFT_LIMIT);
    return NO_ANSWER;
  }
  machine::queue_move(action.target_mm, action.is_rapid ? 0.0f : action.modal.feed, State::run);
  return OK;
}

// --- jogs and measured moves ----------------------------------------------------------------------------------------

uint8_t read_jog(const char* text, gcode::Action& action) {
  float position[AXES];
  machine::target_position(position);
  uint8_t error = gcode::read(text, machine::modal(), position, true, action);
  if (error != OK) return error;
  error = check_target(action.target_mm);
  if (error != OK) return error;
  return is_beyond_travel(action.target_mm) ? BEYOND_TRAVEL : OK;
}

uint8_t jog(const char* text) {
  if (machine::state() != State::idle && machine::state() != State::jog) return NOT_IDLE;
  gcode::Action action;
  uint8_t error = read_jog(text, action);
  if (error == OK) machine::queue_move(action.target_mm, action.modal.feed, State::jog);
  return error;
}

uint8_t measured_move(const char* text) {
  if (machine::state() != State::idle) return NOT_IDLE;
  gcode::Action action;
  uint8_t error = read_jog(text, action);
  if (error != OK) return error;
  float before_mm[AXES];
  bool has_approach = false;
  for (uint8_t i = 0; i < AXES; ++i) {
    before_mm[i] = action.target_mm[i] - settings::now.approach_mm[i];
    has_approach = has_approach || settings::now.approach_mm[i] != 0.0f;
  }
  if (has_approach) {
    if (is_beyond_travel(before_mm)) return BEYOND_TRAVEL;
    machine::queue_move(before_mm, action.modal.feed, State::jog);
  }
  machine::queue_move(action.target_mm, action.modal.feed, State::jog);
  wait_for_rest();
  while (!machine::is_aborted() && !machine::is_settled()) machine::service(true);
  int32_t steps[AXES];
  stepper::positions(steps);
  for (uint8_t i = 0; i < AXES; ++i)
    if (steps[i] != static_cast<int32_t>(lroundf(action.target_mm[i] * settings::now.steps_per_mm[i]))) return BROKEN_OFF;
  return OK;
}

// --- other $ lines --------------------------------------------------------------------------------------------------

uint8_t trigger_line(const char* text) {
  if (*text == '\0') {
    if (machine::state() == State::hold || machine::state() == State::check) return NOT_IDLE;
    wait_for_rest();
    while (!machine::is_aborted() && !machine::is_settled()) machine::service(true);
    if (!machine::is_aborted()) trigger::fire();
    return OK;
  }
  if (is_text(text, UVGS_TEXT("=0"))) {
    trigger::disarm();
    return OK;
  }
  if (*text++ != '=') return BAD_COMMAND;
  if (*text < 'X' || *text > 'Z') return BAD_COMMAND;
  uint8_t axis = static_cast<uint8_t>(*text++ - 'X');
  int32_t at, every = 0;
  if (!read_integer(text, at)) return BAD_NUMBER;
  if (*text == ',' && !read_integer(++text, every)) return BAD_NUMBER;
  if (*text != '\0') return BAD_NUMBER;
  trigger::arm(axis, at, every);
  return OK;
}

uint8_t set_setting(const char* text) {
  int32_t number;
  float value;
  if (!read_integer(text, number) || number < 0 || number > 255 || *text++ != '=') return BAD_COMMAND;
  if (!gcode::read_number(text, value) || *text != '\0') return BAD_NUMBER;
  uint8_t error = settings::set(static_cast<uint16_t>(number), value);
  if (error != OK) return error;
  // What gives the counters their meaning has changed.
  if (number == 3 || number == 5 || number == 23 || (number >= 100 && number <= 102) || number >= 130)
    if (number < 200) limits::forget_homed();
  stepper::apply_settings();
  hal::watch_strobe(settings::now.strobe_edge);
  machine::sync_target();
  hal::Quiet quiet;
  limits::on_change();
  return OK;
}

void identify() {
  print_line(UVGS_TEXT("[VER:1.1h.20261122:uvgs_gantry]"));
  print_line(UVGS_TEXT("[OPT:V,15,128]"));
  print_line(UVGS_TEXT("[FIRMWARE:uvgs_gantry]"));
  serial::text(UVGS_TEXT("[BOOT:"));
  serial::unsigned_number(settings::boot_number());
  serial::put(',');
  machine::print_reset_cause();
  serial::put(']');
  serial::end_line();
}

void print_offsets() {
  for (uint8_t system = 4; system <= 9; ++system) {
    serial::text(UVGS_TEXT("[G5"));
    serial::put(static_cast<char>('0' + system));
    print_line(UVGS_TEXT(":0.000,0.000,0.000]"));
  }
  print_line(UVGS_TEXT("[G28:0.000,0.000,0.000]"));
  print_line(UVGS_TEXT("[G30:0.000,0.000,0.000]"));
  print_line(UVGS_TEXT("[G92:0.000,0.000,0.000]"));
  print_line(UVGS_TEXT("[TLO:0.000]"));
  print_line(UVGS_TEXT("[PRB:0.000,0.000,0.000:0]"));
}

uint8_t home() {
  if (!settings::now.homing) return NO_HOMING;
  if (limits::is_estop_pressed()) return ESTOP;
  machine::set_state(State::home);
  uint8_t alarm = limits::run_homing();
  if (alarm != 0) {
    if (!machine::is_aborted()) machine::abort(alarm);
    return NO_ANSWER;
  }
  machine::sync_target();
  machine::send_homing_report();
  machine::set_state(State::idle);
  report::tell_overrides_next();
  return OK;
}

uint8_t toggle_check() {
  if (machine::state() == State::check) {
    print_line(UVGS_TEXT("[MSG:Disabled]"));
    print_line(UVGS_TEXT("ok"));
    machine::line_answered();
    machine::abort(0);
    return NO_ANSWER;
  }
  if (machine::state() != State::idle) return NOT_IDLE;
  machine::set_state(State::check);
  print_line(UVGS_TEXT("[MSG:Enabled]"));
  return OK;
}

uint8_t sleep() {
  print_line(UVGS_TEXT("ok"));
  print_line(UVGS_TEXT("[MSG:Sleeping]"));
  machine::line_answered();
  machine::set_state(State::sleep);
  report::tell_overrides_next();
  hal::set_motor_enable(!settings::now.enable_invert);
  hal::set_led(0);
  while (!machine::is_aborted()) machine::service(false);
  return NO_ANSWER;
}

uint8_t unlock() {
  if (machine::state() != State::alarm) return OK;
  if (limits::is_estop_pressed()) return ESTOP;
  machine::set_state(State::idle);
  print_line(UVGS_TEXT("[MSG:Caution: Unlocked]"));
  return OK;
}

// Lines that ask only, allowed at any time.
bool answer_query(const char* text) {
  if (*text == '\0') {
    print_line(UVGS_TEXT("[HLP:$$ $# $G $I $N $x=val $J=line $SLP $C $X $H $S $P $L $E $T $M=line ~ ! ? ctrl-x]"));
  } else if (is_text(text, UVGS_TEXT("G"))) {
    report::modes();
  } else if (is_text(text, UVGS_TEXT("P"))) {
    report::Snapshot snapshot;
    {
      hal::Quiet quiet;
      report::take_snapshot(snapshot);
    }
    report::exact(UVGS_TEXT("POS"), snapshot);
  } else if (is_text(text, UVGS_TEXT("L"))) {
    trigger::print_stamps();
  } else if (is_text(text, UVGS_TEXT("E"))) {
    limits::print_edges();
  } else {
    return false;
  }
  return true;
}

uint8_t run_dollar(const char* text) {
  if (answer_query(text)) return OK;
  if (text[0] == 'J' && text[1] == '=') return jog(text + 2);
  if (text[0] == 'M' && text[1] == '=') return measured_move(text + 2);
  if (text[0] == 'T') return trigger_line(text + 1);
  if (is_text(text, UVGS_TEXT("C"))) return toggle_check();
  if (is_text(text, UVGS_TEXT("X"))) return unlock();
  if (machine::state() != State::idle && machine::state() != State::alarm) return NOT_IDLE;
  if (is_text(text, UVGS_TEXT("H"))) return home();
  if (is_text(text, UVGS_TEXT("SLP"))) return sleep();
  if (is_text(text, UVGS_TEXT("$"))) {
    settings::print_all(false);
  } else if (is_text(text, UVGS_TEXT("S"))) {
    settings::print_all(true);
  } else if (is_text(text, UVGS_TEXT("I"))) {
    identify();
  } else if (is_text(text, UVGS_TEXT("#"))) {
    print_offsets();
  } else if (is_text(text, UVGS_TEXT("N"))) {
    print_line(UVGS_TEXT("$N0="));
    print_line(UVGS_TEXT("$N1="));
  } else if (is_text(text, UVGS_TEXT("RST=$"))) {
    settings::restore_defaults();
    limits::forget_homed();
    machine::sync_target();
    print_line(UVGS_TEXT("[MSG:Restoring defaults]"));
  } else {
    return set_setting(text);
  }
  return OK;
}

uint8_t run_text(const char* text) {
  if (*text == '$') return run_dollar(text + 1);
  if (*text == '\0') return OK;
  if (machine::state() == State::alarm || machine::state() == State::jog) return LOCKED;
  return run_gcode(text);
}

}  // namespace

void forget_numbers() { has_number = false; }

uint8_t run_line(const LineReader& line) {
  if (line.fault() == LineReader::Fault::too_long) return TOO_LONG;
  if (line.fault() == LineReader::Fault::bad_checksum) return BAD_CHECKSUM;
  const char* text = line.text();
  int32_t number;
  if (!line.has_checksum() || *text != 'N') return run_text(text);
  if (!read_integer(++text, number) || number < 0) return BAD_SEQUENCE;
  uint32_t n = static_cast<uint32_t>(number);
  if (has_number && n == last_number) return last_code;
  if (has_number && n != last_number + 1) return BAD_SEQUENCE;
  uint8_t code = run_text(text);
  has_number = true;
  last_number = n;
  last_code = code == NO_ANSWER ? OK : code;
  return code;
}

}  // namespace commands
}  // namespace uvgs
