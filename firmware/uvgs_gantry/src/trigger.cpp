#include "trigger.h"

#include "serial.h"
#include "settings.h"
#include "stepper.h"

namespace uvgs {
namespace trigger {
namespace {

constexpr uint8_t STAMPS = 16;

struct Stamp {
  uint32_t ticks;  // the low part of its moment: the rest is put back when it is printed within 35 minutes
  int32_t position[AXES];
  char kind;
};

Stamp ring[STAMPS];
// All stamps since the start; the ring holds the last `held` of them.
volatile uint16_t total;
volatile uint8_t held;
volatile bool is_lost;
volatile uint8_t armed_axes;  // one bit or none
uint8_t armed_axis;
int32_t armed_at, armed_every;

void stamp(char kind, Instant instant) {
  Stamp& entry = ring[total & (STAMPS - 1)];
  entry.ticks = instant.ticks();
  entry.kind = kind;
  for (uint8_t i = 0; i < AXES; ++i) entry.position[i] = stepper::position_in_interrupt(i);
  total = total + 1;
  if (held < STAMPS) {
    held = held + 1;
  } else {
    is_lost = true;
  }
}

Instant whole(uint32_t ticks) {
  Instant moment = hal::now();
  uint32_t age = moment.ticks() - ticks;
  // Borrow when the low part of the age is more than that of now.
  moment.high -= (age >> 16) + (static_cast<uint16_t>(age) > moment.low ? 1 : 0);
  moment.low = static_cast<uint16_t>(ticks);
  return moment;
}

void fire_in_interrupt() {
  Instant instant = hal::now();
  hal::trigger_pulse(settings::now.trigger_us);
  stamp('T', instant);
}

}  // namespace

void init() {
  hal::Quiet quiet;
  total = 0;
  held = 0;
  is_lost = false;
  armed_axes = 0;
}

void disarm() { armed_axes = 0; }

void arm(uint8_t axis, int32_t at, int32_t every) {
  hal::Quiet quiet;
  armed_axis = axis;
  armed_at = at;
  armed_every = every < 0 ? -every : every;
  armed_axes = static_cast<uint8_t>(1 << axis);
}

void fire() {
  hal::Quiet quiet;
  fire_in_interrupt();
}

void print_stamps() {
  while (held > 0) {
    Stamp entry;
    uint16_t n;
    {
      hal::Quiet quiet;
      n = static_cast<uint16_t>(total - held);
      entry = ring[n & (STAMPS - 1)];
      held = held - 1;
    }
    serial::begin_checked(UVGS_TEXT("STAMP"));
    serial::unsigned_number(n);
    serial::put('|');
    serial::put(entry.kind);
    serial::put('|');
    serial::microseconds(whole(entry.ticks));
    for (uint8_t i = 0; i < AXES; ++i) {
      serial::put(i == 0 ? '|' : ',');
      serial::number(entry.position[i]);
    }
    serial::end_checked();
  }
  is_lost = false;
}

bool has_lost() { return is_lost; }

void on_steps(uint8_t axes, uint8_t negative) {
  if (!(axes & armed_axes)) return;
  if (stepper::position_in_interrupt(armed_axis) != armed_at) return;
  fire_in_interrupt();
  if (armed_every == 0) {
    armed_axes = 0;
    return;
  }
  armed_at += negative & armed_axes ? -armed_every : armed_every;
}

void on_strobe(Instant instant) { stamp('S', instant); }

}  // namespace trigger
}  // namespace uvgs
