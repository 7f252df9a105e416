// The ATmega328P at 16 MHz: Arduino Uno or Nano with GRBL's pins.
//
// Timer 1 runs freely at 2 MHz: it is the clock, paces the steps (compare A) and stamps the camera strobe (input
// capture, fed by the analog comparator from A5). Timer 0 runs freely at 250 kHz, ends trigger
// pulses (compare B) and wakes the program while it waits (compare A). Timer 2 dims the LED at 62.5 kHz.
#ifdef __AVR__

#include "hal.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "limits.h"
#include "machine.h"
#include "serial.h"
#include "settings.h"
#include "stepper.h"
#include "trigger.h"

static_assert(F_CPU == 16000000UL, "ticks are counted from 16 MHz");

namespace uvgs {
namespace hal {
namespace {

// Port D: steps on 2, 3, 4 and directions on 5, 6, 7.
constexpr uint8_t STEP_SHIFT = 2, DIRECTION_SHIFT = 5;
constexpr uint8_t STEP_PINS = ALL_AXES << STEP_SHIFT, DIRECTION_PINS = ALL_AXES << DIRECTION_SHIFT;
// Port B: motors on 8, limits on 9, 10 and 12, LED on 11. Port C: emergency stop on A0, trigger on A3, strobe on A5.
constexpr uint8_t ENABLE_PIN = 1 << 0, LED_PIN = 1 << 3;
constexpr uint8_t LIMIT_X = 1 << 1, LIMIT_Y = 1 << 2, LIMIT_Z = 1 << 4;
constexpr uint8_t ESTOP_PIN = 1 << 0, TRIGGER_PIN = 1 << 3;
constexpr uint8_t STROBE_CHANNEL = 5;

constexpr uint8_t MARGIN_TICKS = 8;
// Simulators never match a compare value of 0: half a microsecond later they do, and nothing else minds.
constexpr uint16_t not_zero(uint16_t ticks) { return ticks == 0 ? 1 : ticks; }
constexpr uint16_t LONGEST_TRIGGER_TURN = 250;  // counts of 4 us

volatile uint32_t overflows;
uint8_t step_idle;
uint16_t trigger_left, pulse_begun;
ResetCause cause;

}  // namespace

void init() {
  cli();
  PORTD = (PORTD & ~(STEP_PINS | DIRECTION_PINS));
  DDRD |= STEP_PINS | DIRECTION_PINS;
  PORTB = static_cast<uint8_t>((PORTB & ~LED_PIN) | LIMIT_X | LIMIT_Y | LIMIT_Z);
  DDRB = static_cast<uint8_t>((DDRB | ENABLE_PIN | LED_PIN) & ~(LIMIT_X | LIMIT_Y | LIMIT_Z));
  PORTC = static_cast<uint8_t>((PORTC | ESTOP_PIN) & ~TRIGGER_PIN);
  DDRC = static_cast<uint8_t>((DDRC | TRIGGER_PIN) & ~ESTOP_PIN);

  TIMSK0 = TIMSK1 = TIMSK2 = 0;
  TCCR1A = 0;
  OCR1A = 0x8000;
  TCNT1 = 0;
  overflows = 0;
  TIFR1 = 0xFF;
  TCCR1B = 1 << CS11;
  TIMSK1 = 1 << TOIE1;

  TCCR0A = 0;
  OCR0A = OCR0B = 128;
  TCCR0B = (1 << CS01) | (1 << CS00);

  // 115200 baud with the double-speed divider: 2.1 % fast, as every Uno.
  UCSR0A = 1 << U2X0;
  UBRR0 = 16;
  UCSR0C = (1 << UCSZ01) | (1 << UCSZ00);
  UCSR0B = (1 << RXEN0) | (1 << TXEN0) | (1 << RXCIE0);

  PCMSK0 = LIMIT_X | LIMIT_Y | LIMIT_Z;
  PCMSK1 = ESTOP_PIN;
  PCICR = (1 << PCIE0) | (1 << PCIE1);

  set_sleep_mode(SLEEP_MODE_IDLE);
  wdt_enable(WDTO_1S);
  sei();
}

ResetCause reset_cause() { return cause; }

uint8_t flash_byte(const void* address) { return pgm_read_byte(address); }

Quiet::Quiet() : before_(SREG) { cli(); }
Quiet::~Quiet() { SREG = before_; }

Instant now() {
  Quiet quiet;
  uint16_t low = TCNT1;
  uint32_t high = overflows;
  // An overflow that waits for its interrupt belongs to a small count.
  if ((TIFR1 & (1 << TOV1)) && low < 0x8000) ++high;
  return Instant{high, low};
}

uint32_t ticks() { return now().ticks(); }

void idle(bool has_deadline) {
  if (settings::is_writing()) start_writing();
  if (has_deadline) {
    OCR0A = (TCNT0 - 1) | 1;
    TIFR0 = 1 << OCF0A;
    TIMSK0 |= 1 << OCIE0A;
  } else {
    TIMSK0 &= static_cast<uint8_t>(~(1 << OCIE0A));
  }
  cli();
  if (machine::has_work()) {
    sei();
    return;
  }
  sleep_enable();
  // No interrupt can come between these two: the one after sei() always runs.
  sei();
  sleep_cpu();
  sleep_disable();
}

void watchdog_feed() { wdt_reset(); }

void start_sending() { UCSR0B |= 1 << UDRIE0; }

void step_timer_start(uint16_t ticks_from_now) {
  Quiet quiet;
  OCR1A = not_zero(TCNT1 + ticks_from_now);
  TIFR1 = 1 << OCF1A;
  TIMSK1 |= 1 << OCIE1A;
}

void step_timer_next(uint16_t ticks_from_last) {
  uint16_t next = OCR1A + ticks_from_last;
  // When the interrupt came so late that the moment is over, the step is made as soon as possible, not a turn later.
  if (static_cast<int16_t>(next - TCNT1) < MARGIN_TICKS && ticks_from_last < 0x8000)
    next = TCNT1 + MARGIN_TICKS;
  OCR1A = not_zero(next);
}

void step_timer_stop() { TIMSK1 &= static_cast<uint8_t>(~(1 << OCIE1A)); }

void set_step_idle_levels(uint8_t levels) {
  Quiet quiet;
  step_idle = static_cast<uint8_t>(levels << STEP_SHIFT);
  PORTD = static_cast<uint8_t>((PORTD & ~STEP_PINS) | step_idle);
}

void begin_step_pulse(uint8_t axes) {
  PORTD = static_cast<uint8_t>((PORTD & ~STEP_PINS) | (step_idle ^ (axes << STEP_SHIFT)));
  pulse_begun = TCNT1;
}

void end_step_pulse(uint8_t pulse_us) {
  while (TCNT1 - pulse_begun < static_cast<uint16_t>(pulse_us) * 2) {
  }
  PORTD = static_cast<uint8_t>((PORTD & ~STEP_PINS) | step_idle);
}

void set_directions(uint8_t levels) {
  PORTD = static_cast<uint8_t>((PORTD & ~DIRECTION_PINS) | ((levels << DIRECTION_SHIFT) & DIRECTION_PINS));
}

void set_motor_enable(bool level) {
  if (level) {
    PORTB |= ENABLE_PIN;
  } else {
    PORTB &= static_cast<uint8_t>(~ENABLE_PIN);
  }
}

uint8_t limit_levels() {
  uint8_t pins = PINB, levels = 0;
  if (pins & LIMIT_X) levels |= 1 << 0;
  if (pins & LIMIT_Y) levels |= 1 << 1;
  if (pins & LIMIT_Z) levels |= 1 << 2;
  return levels;
}

bool estop_level() { return PINC & ESTOP_PIN; }

void watch_strobe(uint8_t edge) {
  Quiet quiet;
  if (edge == 0) {
    TIMSK1 &= static_cast<uint8_t>(~(1 << ICIE1));
    ACSR = 1 << ACD;
    return;
  }
  // The comparator weighs A5 against 1.1 V and its output drives the input capture; a higher A5 makes the output low.
  ADCSRA = 0;
  ADMUX = STROBE_CHANNEL;
  ADCSRB = 1 << ACME;
  ACSR = (1 << ACBG) | (1 << ACIC);
  if (edge == 2) {
    TCCR1B |= 1 << ICES1;
  } else {
    TCCR1B &= static_cast<uint8_t>(~(1 << ICES1));
  }
  TIFR1 = 1 << ICF1;
  TIMSK1 |= 1 << ICIE1;
}

namespace {

void time_trigger() {
  uint16_t turn = trigger_left < LONGEST_TRIGGER_TURN ? trigger_left : LONGEST_TRIGGER_TURN;
  trigger_left -= turn;
  uint8_t end = static_cast<uint8_t>(TCNT0 + turn);
  OCR0B = end == 0 ? 1 : end;
  TIFR0 = 1 << OCF0B;
  TIMSK0 |= 1 << OCIE0B;
}

}  // namespace

void trigger_pulse(uint16_t width_us) {
  Quiet quiet;
  PORTC |= TRIGGER_PIN;
  // One more count, so that the pulse is never shorter than asked.
  trigger_left = static_cast<uint16_t>(width_us / 4 + 1);
  time_trigger();
}

void set_led(uint8_t duty) {
  if (duty == 0 || duty == 255) {
    TCCR2A = 0;
    if (duty == 0) {
      PORTB &= static_cast<uint8_t>(~LED_PIN);
    } else {
      PORTB |= LED_PIN;
    }
    return;
  }
  OCR2A = duty;
  TCCR2A = (1 << COM2A1) | (1 << WGM21) | (1 << WGM20);
  TCCR2B = 1 << CS20;
}

uint8_t eeprom_read(uint16_t address) {
  while (EECR & (1 << EEPE)) {
  }
  EEAR = address;
  EECR |= 1 << EERE;
  return EEDR;
}

namespace {

settings::Write write_some() {
  Quiet quiet;
  if (EECR & (1 << EEPE)) return settings::Write::byte;
  uint16_t address;
  uint8_t value;
  settings::Write what = settings::next_to_write(address, value);
  if (what == settings::Write::byte) {
    EEAR = address;
    EEDR = value;
    EECR |= 1 << EEMPE;
    EECR |= 1 << EEPE;
  }
  if (what == settings::Write::done) {
    EECR &= static_cast<uint8_t>(~(1 << EERIE));
  } else {
    EECR |= 1 << EERIE;
  }
  return what;
}

}  // namespace

void start_writing() {
  while (write_some() == settings::Write::again) {
  }
}

}  // namespace hal
}  // namespace uvgs

using namespace uvgs;

// Before anything else: a watchdog that has fired would fire again, and its flag is lost with the first write. Optiboot
// clears the flags and leaves them in r2.
extern "C" void uvgs_keep_reset_cause() __attribute__((naked, used, section(".init3")));
uint8_t uvgs_reset_flags __attribute__((section(".noinit")));
extern "C" void uvgs_keep_reset_cause() {
  asm volatile("mov r24, r2" ::: "r24");
  asm volatile("sts uvgs_reset_flags, r24");
  if (MCUSR != 0) uvgs_reset_flags = MCUSR;
  MCUSR = 0;
  wdt_disable();
}

namespace uvgs {
namespace hal {
namespace {

struct ReadCause {
  ReadCause() {
    if (uvgs_reset_flags & (1 << WDRF)) {
      cause = ResetCause::watchdog;
    } else if (uvgs_reset_flags & (1 << PORF)) {
      cause = ResetCause::power;
    } else if (uvgs_reset_flags & (1 << BORF)) {
      cause = ResetCause::brown_out;
    } else {
      cause = ResetCause::button;
    }
  }
} read_cause;

}  // namespace
}  // namespace hal
}  // namespace uvgs

ISR(TIMER1_OVF_vect) { hal::overflows = hal::overflows + 1; }

ISR(TIMER1_COMPA_vect) { stepper::on_timer(); }

ISR(TIMER1_CAPT_vect) {
  uint16_t low = ICR1;
  uint32_t high = hal::overflows;
  if ((TIFR1 & (1 << TOV1)) && low < 0x8000) ++high;
  trigger::on_strobe(Instant{high, low});
}

ISR(TIMER0_COMPA_vect) { TIMSK0 &= static_cast<uint8_t>(~(1 << OCIE0A)); }

ISR(TIMER0_COMPB_vect) {
  if (hal::trigger_left > 0) {
    hal::time_trigger();
    return;
  }
  PORTC &= static_cast<uint8_t>(~hal::TRIGGER_PIN);
  TIMSK0 &= static_cast<uint8_t>(~(1 << OCIE0B));
}

ISR(PCINT0_vect) { limits::on_change(); }

ISR(PCINT1_vect) { limits::on_change(); }

ISR(USART_RX_vect) {
  uint8_t byte = UDR0;
  serial::on_received(byte);
}

ISR(USART_UDRE_vect) {
  uint8_t byte;
  if (serial::next_to_send(byte)) {
    UDR0 = byte;
  } else {
    UCSR0B &= static_cast<uint8_t>(~(1 << UDRIE0));
  }
}

// Fires for as long as the memory is ready; in simulators only when a byte is done, so idle() asks too.
ISR(EE_READY_vect) { hal::write_some(); }

#endif
