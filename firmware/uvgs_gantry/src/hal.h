// What the core needs from a board. hal_avr.cpp is the ATmega328P; ../../host/hal_host.cpp a virtual one.
//
// "Interrupt" functions of the core (on_...) are called by the board with interrupts off. Everything else runs in the
// main program. Time is counted in ticks of 0.5 us by the same counter that paces the step pulses.
#pragma once
#include <stdint.h>

#ifdef __AVR__
// Tables made from switches would lie in memory, which is scarce; the Arduino IDE cannot be told so otherwise.
#pragma GCC optimize("no-tree-switch-conversion")
#include <avr/pgmspace.h>
#define UVGS_FLASH PROGMEM
#define UVGS_TEXT(text) PSTR(text)
#else
#define UVGS_FLASH
#define UVGS_TEXT(text) (text)
#endif

namespace uvgs {

constexpr uint8_t AXES = 3;
constexpr uint8_t ALL_AXES = (1 << AXES) - 1;
constexpr float TICKS_PER_S = 2000000.0f;
constexpr uint32_t TICKS_PER_MS = 2000;

// A moment since the start, in ticks: high * 65536 + low. Lasts 4 years.
struct Instant {
  uint32_t high;
  uint16_t low;
  uint32_t ticks() const { return (high << 16) | low; }
};

namespace hal {

enum class ResetCause : uint8_t { power, button, brown_out, watchdog };

void init();
ResetCause reset_cause();
uint8_t flash_byte(const void* address);

// Interrupts are off while one of these lives.
class Quiet {
 public:
  Quiet();
  ~Quiet();

 private:
  uint8_t before_;
};

Instant now();
// The low 32 bits of now(): differences are right up to 35 minutes.
uint32_t ticks();
// Sleep until an interrupt, unless machine::has_work(); within about 1 ms when a deadline is being waited for.
void idle(bool has_deadline);
void watchdog_feed();

// Serial line: send what serial::next_to_send() gives; received bytes go to serial::on_received().
void start_sending();

// Step timer: calls stepper::on_timer() after so many ticks from now, or from the last call.
void step_timer_start(uint16_t ticks_from_now);
void step_timer_next(uint16_t ticks_from_last);
void step_timer_stop();

// Pins. Bit i belongs to axis i; levels are those of the pins, inversion is the core's work.
void set_step_idle_levels(uint8_t levels);
// The pulse is begun at the start of the step interrupt and ended by the same interrupt, no sooner than asked: an end by
// another interrupt could come so late that two pulses become one.
void begin_step_pulse(uint8_t axes);
void end_step_pulse(uint8_t pulse_us);
void set_directions(uint8_t levels);
void set_motor_enable(bool level);
uint8_t limit_levels();
bool estop_level();
// Changes of limit and emergency-stop pins call limits::on_change(); chosen edges of the strobe trigger::on_strobe().
void watch_strobe(uint8_t edge);
void trigger_pulse(uint16_t width_us);
// 0 is off, 255 steadily on.
void set_led(uint8_t duty);

// Memory that outlives power. Writing calls settings::next_to_write() whenever the memory is ready.
uint8_t eeprom_read(uint16_t address);
void start_writing();

}  // namespace hal
}  // namespace uvgs
