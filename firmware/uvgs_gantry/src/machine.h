// The state of the whole: what is allowed when, what real-time bytes do, how everything ends safely.
#pragma once
#include "gcode.h"
#include "hal.h"

namespace uvgs {
namespace machine {

enum class State : uint8_t { idle, run, hold, jog, alarm, check, home, sleep };

// Never returns.
void run();

// --- main program ---
State state();
void set_state(State state);
gcode::Modal& modal();
// Do what interrupts and the clock ask for, keep the steps coming, and sleep when there is nothing else. Every wait
// is a loop around this that ends when is_aborted().
void service(bool has_deadline);
bool is_aborted();
// End the present activity as a reset does; an alarm number is told first.
void abort(uint8_t alarm);
// An alarm after which nothing is answered until a reset. Does not return before that.
void critical_alarm(uint8_t alarm);
void queue_move(const float target_mm[AXES], float feed_mm_min, State while_moving);
// Where the next move starts from.
void target_position(float out_mm[AXES]);
void sync_target();
void cancel_jog();
void set_led(const gcode::Modal& modal);
void send_homing_report();
bool is_settled();
// The line under way has got its answer by other means.
void line_answered();
void print_reset_cause();

// --- interrupts ---
// True when the byte was a real-time command and not part of a line.
bool on_real_time_byte(uint8_t byte);
void on_hard_limit();
void on_estop();
// Interrupts are off: whether the main program must not sleep now.
bool has_work();

}  // namespace machine
}  // namespace uvgs
