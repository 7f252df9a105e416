#include "stepper.h"

#include <math.h>

#include "settings.h"
#include "trigger.h"

namespace uvgs {
namespace stepper {
namespace {

// About 50 ms are prepared at most: long enough for the main program to print a report, short enough to stop soon.
constexpr float SEGMENT_S = 0.005f;
constexpr uint8_t SEGMENTS = 11;
// Below this many ticks per step the interrupt runs once per step; above, 2, 4 or 8 times, so that the axes with fewer
// steps get theirs in better time.
constexpr uint32_t OVERSAMPLE_TICKS = 500;
constexpr uint8_t MOST_OVERSAMPLED = 3;
constexpr uint32_t FASTEST_TICKS = 66;
constexpr uint16_t WAIT_TICKS = 30000;
constexpr uint16_t FIRST_STEP_TICKS = 200;
// A braked motor still swings after its last step; only then is a stop a stop.
constexpr uint32_t SWING_TICKS = 30 * TICKS_PER_MS;

struct Segment {
  uint32_t ticks;  // per interrupt
  uint16_t events;  // interrupts
  uint8_t block : 4;
  uint8_t level : 3;
  uint8_t is_last : 1;  // of its block
};

Segment ring[SEGMENTS];
volatile uint8_t ring_out, ring_in;
uint8_t next_slot(uint8_t i) { return i + 1 == SEGMENTS ? 0 : static_cast<uint8_t>(i + 1); }

// The generator's place in the block it cuts.
bool is_cutting;
uint32_t steps_left;
float part_step;           // of the next step, already travelled
float part_seconds;        // and the time that took
float debt_ticks;
float steps_per_mm;        // of the axis with most steps, along the path
float speed;               // mm/s
float slow_down_mm, top_speed, exit_speed;
bool must_plan;
enum class Hold : uint8_t { none, braking, stopped };
volatile Hold hold_state;

// The interrupt's state.
volatile bool is_running;
volatile int32_t position[AXES];
uint8_t out_axes, out_negative;
uint32_t counter[AXES], increment[AXES], modulus;
Segment current;
bool has_segment;
// The counters outlive a pause in the middle of a block: its minor axes must end on their exact step.
bool has_block;
uint8_t current_block, current_level;
uint32_t wait_left;
volatile uint8_t locked_axes, lock_mask;
Instant rest_instant;
volatile uint16_t underrun_count;

void begin_block(const planner::Block& block) {
  is_cutting = true;
  steps_left = block.events();
  part_step = part_seconds = debt_ticks = 0.0f;
  steps_per_mm = static_cast<float>(steps_left) / block.length_mm;
  must_plan = true;
}

// Where to stop speeding up and where to slow down, from the present speed and what is left.
void plan_profile(const planner::Block& block) {
  float left = left_mm(block), a2 = 2.0f * block.mm_s2;
  float exit2 = fminf(planner::exit2(), block.nominal_mm_s * block.nominal_mm_s);
  float top2 = 0.5f * (speed * speed + exit2 + a2 * left);
  float nominal2 = block.nominal_mm_s * block.nominal_mm_s;
  if (top2 > nominal2) top2 = nominal2;
  if (top2 < speed * speed) top2 = speed * speed;
  top_speed = sqrtf(top2);
  exit_speed = sqrtf(exit2);
  slow_down_mm = (top2 - exit2) / a2;
  must_plan = false;
}

// One stretch of constant acceleration: at most `seconds`; adds to the distance and gives the time used.
struct Stretch {
  float seconds, mm;
  bool ends_block;
};

Stretch brake(float left, float seconds, float mm_s2, float to_speed, bool stop_inside) {
  float slower = speed - mm_s2 * seconds;
  if (slower > to_speed) {
    float mm = 0.5f * (speed + slower) * seconds;
    if (mm < left) {
      speed = slower;
      return {seconds, mm, false};
    }
  }
  if (stop_inside) {
    float mm = (speed * speed - to_speed * to_speed) / (2.0f * mm_s2);
    if (mm < left) {
      float used = (speed - to_speed) / mm_s2;
      speed = to_speed;
      return {used, mm, false};
    }
    // The block ends before the stop: what speed is left there goes into the next one.
    float end2 = speed * speed - 2.0f * mm_s2 * left;
    to_speed = end2 > 0.0f ? sqrtf(end2) : 0.0f;
  }
  // To the end. Rounding may have left the speed short of what the distance needs.
  float sum = speed + to_speed, least = sqrtf(2.0f * mm_s2 * left);
  speed = to_speed;
  return {2.0f * left / (sum > least ? sum : least), left, true};
}

Stretch advance(const planner::Block& block, float left, float seconds) {
  if (hold_state == Hold::braking) return brake(left, seconds, block.mm_s2, 0.0f, true);
  if (left <= slow_down_mm) return brake(left, seconds, block.mm_s2, exit_speed, false);
  float room = left - slow_down_mm;
  if (speed < top_speed) {
    float faster = speed + block.mm_s2 * seconds;
    if (faster > top_speed) {
      seconds = (top_speed - speed) / block.mm_s2;
      faster = top_speed;
    }
    float mm = 0.5f * (speed + faster) * seconds;
    if (mm > room) {
      // The profile is a triangle and rounding let the room end first.
      seconds *= room / mm;
      faster = speed + block.mm_s2 * seconds;
      mm = room;
    }
    speed = faster;
    return {seconds, mm, left - mm <= 0.0f};
  }
  float mm = speed * seconds;
  if (mm > room) {
    mm = room;
    seconds = room / speed;
  }
  return {seconds, mm, left - mm <= 0.0f};
}

void push_segment(uint32_t steps, float seconds_per_step, bool is_last) {
  // Whole ticks only; what they fall short of in one segment is made up in the next, so that speeds are right on average.
  float exact = seconds_per_step * TICKS_PER_S + debt_ticks / static_cast<float>(steps);
  uint32_t ticks = exact < 1e9f ? static_cast<uint32_t>(exact + 0.5f) : 1000000000u;
  if (ticks < FASTEST_TICKS) ticks = FASTEST_TICKS;
  uint8_t level = 0;
  while (level < MOST_OVERSAMPLED && ticks >= OVERSAMPLE_TICKS) {
    ticks = (ticks + 1) >> 1;
    ++level;
  }
  debt_ticks = (exact - static_cast<float>(ticks << level)) * static_cast<float>(steps);
  Segment& segment = ring[ring_in];
  segment.ticks = ticks;
  segment.events = static_cast<uint16_t>(steps << level);
  segment.block = planner::generating_index() & 0x0F;
  segment.level = level & 0x07;
  segment.is_last = is_last;
  hal::Quiet quiet;
  ring_in = next_slot(ring_in);
}

// Cut one segment off the block; false when a stop came before another whole step.
bool cut(planner::Block& block) {
  float seconds = 0.0f, left = left_mm(block), target_s = SEGMENT_S;
  float travelled = part_step;
  bool ends = false, stops = false;
  while (true) {
    Stretch stretch = advance(block, left, target_s - seconds);
    seconds += stretch.seconds;
    left -= stretch.mm;
    travelled += stretch.mm * steps_per_mm;
    ends = stretch.ends_block;
    stops = !ends && hold_state == Hold::braking && speed <= 0.0f;
    if (ends || stops) break;
    if (seconds < 0.999f * target_s) continue;
    if (travelled >= 1.0f) break;
    // Slow: the segment lasts until there is a step to make.
    target_s += SEGMENT_S;
  }
  uint32_t steps = static_cast<uint32_t>(travelled);
  if (ends || steps > steps_left) steps = steps_left;
  bool is_last = steps == steps_left;
  // The part of a step left over from the segment before counts with its time, so every step comes when it is due.
  float per_step = (part_seconds + seconds) / (travelled > 0.01f ? travelled : 0.01f);
  if (steps > 0) {
    push_segment(steps, per_step, is_last);
    steps_left -= steps;
  }
  part_step = is_last ? 0.0f : travelled - static_cast<float>(steps);
  part_seconds = is_last || stops ? 0.0f : part_step * per_step;
  if (stops) hold_state = Hold::stopped;
  return is_last;
}

}  // namespace

void init() {
  hal::Quiet quiet;
  for (uint8_t i = 0; i < AXES; ++i) position[i] = 0;
  underrun_count = 0;
  rest_instant = Instant{0, 0};
  lock_mask = 0;
  discard();
}

void discard() {
  hal::Quiet quiet;
  ring_out = ring_in = 0;
  is_cutting = has_segment = has_block = is_running = false;
  out_axes = 0;
  wait_left = 0;
  speed = 0.0f;
  locked_axes = 0;
  hold_state = Hold::none;
}

bool needs_preparing() {
  return hold_state != Hold::stopped && next_slot(ring_in) != ring_out && planner::generating() != nullptr;
}

void prepare() {
  while (needs_preparing()) {
    planner::Block& block = *planner::generating();
    if (!is_cutting) begin_block(block);
    if (must_plan) plan_profile(block);
    if (!cut(block)) continue;
    is_cutting = false;
    planner::generated();
    if (planner::generating() != nullptr) continue;
    // The end of all that is planned is a stop.
    speed = 0.0f;
    if (hold_state == Hold::braking) hold_state = Hold::stopped;
  }
}

void start() {
  if (is_running || ring_in == ring_out) return;
  hal::set_motor_enable(settings::now.enable_invert);
  {
    hal::Quiet quiet;
    is_running = true;
  }
  hal::step_timer_start(FIRST_STEP_TICKS);
}

void hold() {
  if (hold_state == Hold::none) hold_state = speed > 0.0f ? Hold::braking : Hold::stopped;
}

bool is_holding() { return hold_state != Hold::none; }

bool has_stopped() {
  return hold_state == Hold::stopped && !is_running && hal::ticks() - rested_since().ticks() >= SWING_TICKS;
}

void resume() {
  hold_state = Hold::none;
  planner::replan();
}

bool is_moving() { return is_running; }

Instant rested_since() {
  hal::Quiet quiet;
  return rest_instant;
}

void positions(int32_t out[AXES]) {
  hal::Quiet quiet;
  for (uint8_t i = 0; i < AXES; ++i) out[i] = position[i];
}

void set_positions(const int32_t steps[AXES]) {
  hal::Quiet quiet;
  for (uint8_t i = 0; i < AXES; ++i) position[i] = steps[i];
}

float speed_mm_s() { return speed; }

float left_mm(const planner::Block& block) {
  return is_cutting ? (static_cast<float>(steps_left) - part_step) / steps_per_mm : block.length_mm;
}

void plan_changed() { must_plan = true; }

uint16_t underruns() {
  hal::Quiet quiet;
  return underrun_count;
}

void lock_on_limit(uint8_t axes) {
  hal::Quiet quiet;
  locked_axes = 0;
  lock_mask = axes;
}

uint8_t locked() { return locked_axes; }

void apply_settings() { hal::set_step_idle_levels(settings::now.step_invert); }

// --- interrupts -----------------------------------------------------------------------------------------------------

void lock(uint8_t axes) { locked_axes = locked_axes | axes; }
int32_t position_in_interrupt(uint8_t axis) { return position[axis]; }
bool is_moving_in_interrupt() { return is_running; }
uint8_t lock_mask_in_interrupt() { return lock_mask; }

void kill() {
  hal::Quiet quiet;
  hal::step_timer_stop();
  out_axes = 0;
  if (is_running) rest_instant = hal::now();
  is_running = false;
}

namespace {

void load(const Segment& segment) {
  if (!has_block) {
    has_block = true;
    const planner::Block& block = planner::block_at(segment.block);
    current_block = segment.block;
    modulus = block.events() << MOST_OVERSAMPLED;
    // The leading axis steps at the end of its interval whatever the oversampling; the others are centred between.
    for (uint8_t i = 0; i < AXES; ++i)
      counter[i] = block.count(i) << MOST_OVERSAMPLED == modulus ? 0 : modulus >> 1;
    out_negative = block.negative();
    hal::set_directions(out_negative ^ settings::now.direction_invert);
    current_level = 0xFF;
  }
  if (segment.level != current_level) {
    const planner::Block& block = planner::block_at(segment.block);
    current_level = segment.level;
    for (uint8_t i = 0; i < AXES; ++i) increment[i] = block.count(i) << (MOST_OVERSAMPLED - current_level);
  }
  current = segment;
  has_segment = true;
}

void schedule(uint32_t ticks) {
  if (ticks > 2u * WAIT_TICKS) {
    wait_left = ticks - WAIT_TICKS;
    ticks = WAIT_TICKS;
  }
  hal::step_timer_next(static_cast<uint16_t>(ticks));
}

void make_steps() {
  uint8_t axes = out_axes & static_cast<uint8_t>(~locked_axes);
  if (axes != 0) {
    hal::begin_step_pulse(axes);
    for (uint8_t i = 0, bit = 1; i < AXES; ++i, bit = static_cast<uint8_t>(bit << 1)) {
      if (!(axes & bit)) continue;
      if (out_negative & bit) {
        position[i] = position[i] - 1;
      } else {
        position[i] = position[i] + 1;
      }
    }
    trigger::on_steps(axes, out_negative);
  }
  out_axes = 0;
  if (has_segment && current.events == 0) {
    has_segment = false;
    ring_out = next_slot(ring_out);
    if (current.is_last) {
      planner::release();
      has_block = false;
    }
  }
  if (!has_segment) {
    if (ring_out == ring_in) {
      if (has_block && hold_state == Hold::none) underrun_count = underrun_count + 1;
      is_running = false;
      rest_instant = hal::now();
      hal::step_timer_stop();
      return;
    }
    load(ring[ring_out]);
  }
  for (uint8_t i = 0; i < AXES; ++i) {
    counter[i] += increment[i];
    if (counter[i] >= modulus) {
      counter[i] -= modulus;
      out_axes |= static_cast<uint8_t>(1 << i);
    }
  }
  --current.events;
  schedule(current.ticks);
}

}  // namespace

void on_timer() {
  if (wait_left > 0) {
    uint32_t ticks = wait_left;
    wait_left = 0;
    schedule(ticks);
    return;
  }
  make_steps();
  hal::end_step_pulse(settings::now.pulse_us);
}

}  // namespace stepper
}  // namespace uvgs
