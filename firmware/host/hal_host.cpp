#include "hal_host.h"

#include "../uvgs_gantry/src/limits.h"
#include "../uvgs_gantry/src/machine.h"
#include "../uvgs_gantry/src/serial.h"
#include "../uvgs_gantry/src/settings.h"
#include "../uvgs_gantry/src/stepper.h"
#include "../uvgs_gantry/src/trigger.h"

namespace virtual_board {

Board board;

namespace {

constexpr Ticks NEVER = ~0ull;
constexpr Ticks MEMORY_TICKS = 6800;      // 3.4 ms for a byte
constexpr Ticks LOOP_TICKS = 20;          // what a turn of the main program costs
constexpr Ticks DEADLINE_TICKS = 2000;
constexpr Ticks OVERFLOW_TICKS = 65536;

Ticks step_at, sending_at, memory_at;
bool is_in_interrupt;

Ticks next_event() {
  Ticks next = step_at;
  if (sending_at < next) next = sending_at;
  if (memory_at < next) next = memory_at;
  if (!board.from_host.empty() && board.from_host.front().t < next) next = board.from_host.front().t;
  return next;
}

void send_next() {
  uint8_t byte;
  if (!uvgs::serial::next_to_send(byte)) {
    sending_at = NEVER;
    return;
  }
  sending_at = board.now + BYTE_TICKS;
  board.to_host.push_back({sending_at, byte});
}

void write_next() {
  uint16_t address;
  uint8_t value;
  switch (uvgs::settings::next_to_write(address, value)) {
    case uvgs::settings::Write::done: memory_at = NEVER; return;
    case uvgs::settings::Write::again: memory_at = board.now + LOOP_TICKS; return;
    default: break;
  }
  memory_at = board.now + MEMORY_TICKS;
  board.memory[address] = value;
  ++board.memory_writes;
}

uint8_t switch_levels() {
  uint8_t levels = 0;
  for (uint8_t i = 0; i < uvgs::AXES; ++i) {
    bool is_closed = board.has_switch[i] && board.motor[i] >= board.switch_at[i];
    if (!is_closed) levels |= static_cast<uint8_t>(1 << i);
  }
  return levels;
}

void run_event() {
  is_in_interrupt = true;
  if (step_at <= board.now) {
    step_at = NEVER;
    uint8_t before = switch_levels();
    uvgs::stepper::on_timer();
    if (switch_levels() != before) uvgs::limits::on_change();
  } else if (!board.from_host.empty() && board.from_host.front().t <= board.now) {
    uint8_t byte = board.from_host.front().byte;
    board.from_host.pop_front();
    uvgs::serial::on_received(byte);
  } else if (sending_at <= board.now) {
    send_next();
  } else if (memory_at <= board.now) {
    write_next();
  }
  is_in_interrupt = false;
}

// Until time t or, after at least `least` of it, the first interrupt: every interrupt wakes the main program.
void run_until(Ticks t, Ticks least) {
  while (true) {
    Ticks event = next_event();
    Ticks next = event < t ? event : t;
    if (next > board.limit) next = board.limit > board.now ? board.limit : board.now;
    if (next > board.now) board.now = next;
    if (event <= board.now) {
      run_event();
      if (least < t) t = least > board.now ? least : board.now;
    } else if (board.now >= board.limit) {
      board.at_limit();
    } else if (board.now >= t) {
      return;
    }
  }
}

}  // namespace

void Board::receive(uint8_t byte, Ticks at) {
  Ticks t = at > now ? at : now;
  if (!from_host.empty() && from_host.back().t + BYTE_TICKS > t) t = from_host.back().t + BYTE_TICKS;
  from_host.push_back({t, byte});
}

void Board::strobe() {
  strobe_level = !strobe_level;
  if (strobe_edge == (strobe_level ? 1 : 2)) uvgs::trigger::on_strobe(uvgs::hal::now());
}

void Board::set_estop(bool level) {
  if (level == estop_level) return;
  estop_level = level;
  uvgs::limits::on_change();
}

void Board::shove(uint8_t axis, int64_t steps) { motor[axis] += steps; }

void power_up() {
  while (true) {
    step_at = sending_at = memory_at = NEVER;
    is_in_interrupt = false;
    board.started = board.now;
    board.from_host.clear();
    board.to_host.clear();
    board.led_duty = 0;
    board.strobe_edge = 0;
    try {
      uvgs::machine::run();
    } catch (const HardReset& reset) {
      board.cause = reset.cause;
    }
  }
}

}  // namespace virtual_board

namespace uvgs {
namespace hal {

using namespace virtual_board;

void init() {}
ResetCause reset_cause() { return board.cause; }
uint8_t flash_byte(const void* address) { return *static_cast<const uint8_t*>(address); }

Quiet::Quiet() : before_(0) {}
Quiet::~Quiet() {}

Instant now() {
  Ticks t = board.now - board.started;
  return Instant{static_cast<uint32_t>(t >> 16), static_cast<uint16_t>(t)};
}

uint32_t ticks() { return static_cast<uint32_t>(board.now - board.started); }

void idle(bool has_deadline) {
  Ticks longest = machine::has_work() ? LOOP_TICKS : has_deadline ? DEADLINE_TICKS : OVERFLOW_TICKS;
  run_until(board.now + longest, board.now + LOOP_TICKS);
}

void watchdog_feed() {}

void start_sending() {
  if (sending_at == NEVER) send_next();
}

void step_timer_start(uint16_t ticks_from_now) { step_at = board.now + ticks_from_now; }
void step_timer_next(uint16_t ticks_from_last) { step_at = board.now + ticks_from_last; }
void step_timer_stop() { step_at = NEVER; }

void set_step_idle_levels(uint8_t) {}

void begin_step_pulse(uint8_t axes) {
  uint8_t negative = board.direction_levels;
  for (uint8_t i = 0; i < AXES; ++i)
    if (axes & (1 << i)) board.motor[i] += negative & (1 << i) ? -1 : 1;
  if (board.on_step) board.on_step({board.now, axes, negative});
}

void end_step_pulse(uint8_t) {}
void set_directions(uint8_t levels) { board.direction_levels = levels; }
void set_motor_enable(bool level) { board.motor_level = level; }
uint8_t limit_levels() { return switch_levels(); }
bool estop_level() { return board.estop_level; }
void watch_strobe(uint8_t edge) { board.strobe_edge = edge; }
void trigger_pulse(uint16_t) { board.trigger_pulses.push_back(board.now); }
void set_led(uint8_t duty) { board.led_duty = duty; }

uint8_t eeprom_read(uint16_t address) { return board.memory[address]; }
void start_writing() {
  if (memory_at == NEVER) write_next();
}

}  // namespace hal
}  // namespace uvgs
