#include "machine.h"

#include <math.h>

#include "commands.h"
#include "limits.h"
#include "line.h"
#include "planner.h"
#include "report.h"
#include "serial.h"
#include "settings.h"
#include "stepper.h"
#include "trigger.h"

namespace uvgs {
namespace machine {
namespace {

constexpr uint8_t WANT_STATUS = 1, WANT_HOLD = 2, WANT_RESUME = 4, WANT_CANCEL = 8, WANT_RESET = 16, WANT_EXACT = 32,
                  SAW_LIMIT = 64, SAW_ESTOP = 128;
constexpr uint8_t ALARM_LIMIT = 1, ALARM_SOFT_LIMIT = 2, ALARM_RESET_MOVING = 3, ALARM_RESET_HOMING = 6, ALARM_ESTOP = 10;
constexpr uint16_t ALARM_SILENCE_MS = 500;
// GRBL pauses so long after '~' before it moves; senders' timing relies on nothing shorter.
constexpr uint16_t RESUME_MS = 160;
constexpr uint8_t MOTORS_ALWAYS_ON = 255;

volatile uint8_t pending;
report::Snapshot asked;
volatile State now_state;
gcode::Modal modes;
LineReader line;
bool is_in_line, is_deaf, is_cancelling, is_resuming, heartbeat_lost;
volatile bool aborted;
volatile uint8_t alarm_to_tell;
uint32_t resume_ticks;
int32_t target_steps[AXES];
float target_mm[AXES];

void clear_pending(uint8_t bits) {
  hal::Quiet quiet;
  pending = pending & static_cast<uint8_t>(~bits);
}

bool is_queue_state() { return now_state == State::run || now_state == State::jog; }

void stop_everything() {
  stepper::kill();
  stepper::discard();
  planner::clear();
  sync_target();
  is_cancelling = is_resuming = false;
}

void wait_ms(uint16_t ms) {
  uint32_t begun = hal::ticks();
  while (hal::ticks() - begun < ms * TICKS_PER_MS) {
    hal::watchdog_feed();
    hal::idle(true);
  }
}

void tell_alarm(uint8_t number) {
  serial::text(UVGS_TEXT("ALARM:"));
  serial::unsigned_number(number);
  serial::end_line();
  if (number != ALARM_SOFT_LIMIT) limits::forget_homed();
  hal::set_led(0);
  wait_ms(ALARM_SILENCE_MS);
}

void greet(bool is_hardware_reset, bool has_settings) {
  serial::end_line();
  serial::text(UVGS_TEXT("Grbl 1.1h ['$' for help]"));
  serial::end_line();
  if (is_hardware_reset) {
    serial::text(UVGS_TEXT("[MSG:Reset: "));
    print_reset_cause();
    serial::text(UVGS_TEXT(", boot "));
    serial::unsigned_number(settings::boot_number());
    serial::put(']');
    serial::end_line();
    if (!has_settings) {
      serial::text(UVGS_TEXT("[MSG:Settings lost, defaults in use]"));
      serial::end_line();
    }
  }
  if (now_state == State::alarm) {
    serial::text(UVGS_TEXT("[MSG:'$H'|'$X' to unlock]"));
    serial::end_line();
  }
}

void answer(uint8_t code) {
  if (code == 0) {
    serial::text(UVGS_TEXT("ok"));
  } else {
    serial::text(UVGS_TEXT("error:"));
    serial::unsigned_number(code);
  }
  serial::end_line();
}

void serve_lines() {
  while (!aborted) {
    int16_t byte = serial::read();
    if (byte < 0) {
      service(false);
      continue;
    }
    if (!line.push(static_cast<char>(byte))) continue;
    is_in_line = true;
    uint8_t code = commands::run_line(line);
    if (aborted) return;
    if (is_in_line && code != commands::NO_ANSWER) answer(code);
    is_in_line = false;
  }
}

void end_motion() {
  now_state = State::idle;
  if (!settings::now.push_done) return;
  report::Snapshot snapshot;
  {
    hal::Quiet quiet;
    report::take_snapshot(snapshot);
  }
  report::exact(UVGS_TEXT("DONE"), snapshot);
}

void serve_holds() {
  if (pending & WANT_HOLD) {
    clear_pending(WANT_HOLD);
    if (now_state == State::jog) {
      cancel_jog();
    } else if (now_state == State::idle || now_state == State::run) {
      now_state = State::hold;
      is_resuming = false;
      stepper::hold();
    }
  }
  if (pending & WANT_CANCEL) {
    clear_pending(WANT_CANCEL);
    cancel_jog();
  }
  if (pending & WANT_RESUME) {
    clear_pending(WANT_RESUME);
    if (now_state == State::hold && stepper::has_stopped()) {
      now_state = planner::is_empty() ? State::idle : State::run;
      is_resuming = true;
      resume_ticks = hal::ticks();
    }
  }
  if (is_resuming && (planner::is_empty() || hal::ticks() - resume_ticks >= RESUME_MS * TICKS_PER_MS)) {
    is_resuming = false;
    stepper::resume();
  }
  if (is_cancelling && stepper::has_stopped()) {
    stop_everything();
    end_motion();
  }
}

void serve_heartbeat() {
  uint16_t limit_ms = settings::now.heartbeat_ms;
  bool is_homing = now_state == State::home;
  if (limit_ms == 0 || !(is_queue_state() || is_homing) || !stepper::is_moving() || is_cancelling) {
    heartbeat_lost = false;
    return;
  }
  // In this order: a byte that comes between the two is heard before now.
  uint32_t heard = serial::last_byte_ticks();
  if (heartbeat_lost || hal::ticks() - heard < limit_ms * TICKS_PER_MS) return;
  heartbeat_lost = true;
  hal::set_led(0);
  modes.spindle = 5;
  if (is_homing) {
    // There is no position to keep: the cycle ends as at a reset.
    abort(ALARM_RESET_HOMING);
    return;
  }
  hal::Quiet quiet;
  pending = pending | WANT_HOLD;
}

void serve_rest() {
  if (is_queue_state() && !stepper::is_holding() && !stepper::is_moving() && planner::is_empty() && !is_resuming)
    end_motion();
  if (now_state != State::idle && now_state != State::alarm) return;
  if (stepper::is_moving() || settings::now.motor_idle_ms == MOTORS_ALWAYS_ON) return;
  if (hal::ticks() - stepper::rested_since().ticks() >= settings::now.motor_idle_ms * TICKS_PER_MS)
    hal::set_motor_enable(!settings::now.enable_invert);
}

}  // namespace

State state() { return now_state; }
void set_state(State state) { now_state = state; }
gcode::Modal& modal() { return modes; }
bool is_aborted() { return aborted; }
void line_answered() { is_in_line = false; }

void print_reset_cause() {
  switch (hal::reset_cause()) {
    case hal::ResetCause::power: serial::text(UVGS_TEXT("power")); break;
    case hal::ResetCause::button: serial::text(UVGS_TEXT("button")); break;
    case hal::ResetCause::brown_out: serial::text(UVGS_TEXT("brown-out")); break;
    default: serial::text(UVGS_TEXT("watchdog"));
  }
}

void abort(uint8_t alarm) {
  alarm_to_tell = alarm;
  aborted = true;
}

void target_position(float out_mm[AXES]) {
  for (uint8_t i = 0; i < AXES; ++i) out_mm[i] = target_mm[i];
}

void sync_target() {
  stepper::positions(target_steps);
  for (uint8_t i = 0; i < AXES; ++i)
    target_mm[i] = static_cast<float>(target_steps[i]) / settings::now.steps_per_mm[i];
}

void queue_move(const float to_mm[AXES], float feed_mm_min, State while_moving) {
  int32_t to[AXES];
  for (uint8_t i = 0; i < AXES; ++i) to[i] = static_cast<int32_t>(lroundf(to_mm[i] * settings::now.steps_per_mm[i]));
  while (planner::free_blocks() == 0) {
    service(false);
    if (aborted) return;
  }
  planner::add(target_steps, to, feed_mm_min / 60.0f);
  for (uint8_t i = 0; i < AXES; ++i) {
    target_steps[i] = to[i];
    target_mm[i] = to_mm[i];
  }
  if (!planner::is_empty() && now_state == State::idle) now_state = while_moving;
}

void cancel_jog() {
  if (now_state != State::jog || is_cancelling) return;
  is_cancelling = true;
  stepper::hold();
}

void set_led(const gcode::Modal& m) {
  float low = settings::now.rpm_min, high = settings::now.rpm_max;
  uint8_t duty = 0;
  if (m.spindle != 5 && m.rpm > 0.0f) {
    if (m.rpm >= high || high <= low) {
      duty = 255;
    } else if (m.rpm > low) {
      duty = static_cast<uint8_t>(255.0f * (m.rpm - low) / (high - low) + 0.5f);
    }
  }
  hal::set_led(duty);
}

bool is_settled() {
  Instant rest = stepper::rested_since();
  return !stepper::is_moving() && hal::ticks() - rest.ticks() >= settings::now.settle_ms * TICKS_PER_MS;
}

void send_homing_report() {
  if (!(pending & WANT_STATUS)) return;
  clear_pending(WANT_STATUS);
  report::status();
}

void service(bool has_deadline) {
  hal::watchdog_feed();
  if (pending & (SAW_LIMIT | SAW_ESTOP)) {
    uint8_t number = pending & SAW_ESTOP ? ALARM_ESTOP : ALARM_LIMIT;
    if (!is_deaf) {
      critical_alarm(number);
      return;
    }
    clear_pending(SAW_LIMIT | SAW_ESTOP);
  }
  if (pending & WANT_RESET) {
    clear_pending(WANT_RESET);
    aborted = true;
    return;
  }
  if (pending & WANT_EXACT) {
    report::exact(UVGS_TEXT("POS"), asked);
    clear_pending(WANT_EXACT);
  }
  if (is_deaf || now_state == State::sleep) {
    if (is_deaf) clear_pending(WANT_STATUS);
    clear_pending(WANT_HOLD | WANT_RESUME | WANT_CANCEL);
  }
  if ((pending & WANT_STATUS) && now_state != State::home) {
    clear_pending(WANT_STATUS);
    report::status();
  }
  bool was_beating = heartbeat_lost;
  serve_heartbeat();
  serve_holds();
  if (heartbeat_lost && !was_beating) {
    serial::text(UVGS_TEXT("[MSG:Heartbeat lost]"));
    serial::end_line();
  }
  if (!is_resuming) {
    stepper::prepare();
    stepper::start();
  }
  serve_rest();
  hal::idle(has_deadline || is_resuming || is_cancelling);
}

void critical_alarm(uint8_t alarm) {
  if (alarm == ALARM_ESTOP) hal::set_motor_enable(!settings::now.enable_invert);
  if (alarm == ALARM_SOFT_LIMIT && stepper::is_moving()) {
    // A soft limit was found while other moves run: these end in a controlled stop first.
    stepper::hold();
    while (!stepper::has_stopped() && !(pending & WANT_RESET)) {
      hal::watchdog_feed();
      stepper::prepare();
      hal::idle(true);
    }
  }
  stop_everything();
  now_state = State::alarm;
  is_deaf = true;
  clear_pending(SAW_LIMIT | SAW_ESTOP);
  tell_alarm(alarm);
  serial::text(UVGS_TEXT("[MSG:Reset to continue]"));
  serial::end_line();
  while (!aborted) service(false);
}

void run() {
  hal::init();
  serial::init();
  stepper::init();
  trigger::init();
  bool has_settings = settings::load();
  limits::init();
  stepper::apply_settings();
  hal::set_motor_enable(!settings::now.enable_invert);
  hal::watch_strobe(settings::now.strobe_edge);
  bool is_hardware_reset = true;
  now_state = settings::now.homing ? State::alarm : State::idle;
  pending = 0;
  alarm_to_tell = 0;
  is_in_line = false;
  aborted = false;
  while (true) {
    stop_everything();
    hal::set_led(0);
    if (alarm_to_tell != 0) {
      now_state = State::alarm;
      tell_alarm(alarm_to_tell);
    }
    if (now_state == State::sleep) limits::forget_homed();
    now_state = now_state == State::alarm || now_state == State::sleep ? State::alarm : State::idle;
    if (is_in_line) answer(0);
    is_in_line = is_deaf = heartbeat_lost = false;
    gcode::clear(modes);
    line.clear();
    commands::forget_numbers();
    report::clear();
    trigger::disarm();
    serial::forget_received();
    clear_pending(static_cast<uint8_t>(~SAW_ESTOP));
    {
      hal::Quiet quiet;
      alarm_to_tell = 0;
      aborted = false;
    }
    greet(is_hardware_reset, has_settings);
    is_hardware_reset = false;
    if (limits::is_estop_pressed()) {
      critical_alarm(ALARM_ESTOP);
      continue;
    }
    serve_lines();
  }
}

// --- interrupts -----------------------------------------------------------------------------------------------------

bool on_real_time_byte(uint8_t byte) {
  uint8_t bit;
  switch (byte) {
    case '?': bit = WANT_STATUS; break;
    case '!': bit = WANT_HOLD; break;
    case '~': bit = WANT_RESUME; break;
    case 0x85: bit = WANT_CANCEL; break;
    case 0xF0:
      if (!(pending & WANT_EXACT)) report::take_snapshot(asked);
      bit = WANT_EXACT;
      break;
    case 0x18:
      if (now_state == State::home) {
        alarm_to_tell = ALARM_RESET_HOMING;
      } else if (stepper::is_moving_in_interrupt()) {
        alarm_to_tell = ALARM_RESET_MOVING;
      }
      stepper::kill();
      bit = WANT_RESET;
      break;
    default: return false;
  }
  pending = pending | bit;
  return true;
}

void on_hard_limit() {
  if (now_state == State::home || !stepper::is_moving_in_interrupt()) return;
  stepper::kill();
  pending = pending | SAW_LIMIT;
}

void on_estop() {
  stepper::kill();
  hal::set_motor_enable(!settings::now.enable_invert);
  hal::set_led(0);
  pending = pending | SAW_ESTOP;
}

bool has_work() {
  return (pending & (now_state == State::home ? static_cast<uint8_t>(~WANT_STATUS) : 0xFF)) != 0 ||
         serial::has_received() || stepper::needs_preparing();
}

}  // namespace machine
}  // namespace uvgs
