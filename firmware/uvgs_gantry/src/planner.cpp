#include "planner.h"

#include <math.h>

#include "settings.h"
#include "stepper.h"

namespace uvgs {
namespace planner {
namespace {

constexpr float NO_LIMIT = 1e12f;

Block blocks[BLOCKS];
// New moves go to `head`; `held` blocks before it are not finished, of which the generator has yet to cut the last
// `waiting`, beginning with `next_up`. The step interrupt only counts `held` down.
volatile uint8_t held;
uint8_t waiting, next_up, head;
float last_unit[AXES];
float last_nominal, last_mm_s2;

uint8_t after(uint8_t index) { return index + 1 == BLOCKS ? 0 : static_cast<uint8_t>(index + 1); }
uint8_t before(uint8_t index) { return index == 0 ? BLOCKS - 1 : static_cast<uint8_t>(index - 1); }

// Squared speed at the corner between the last move and one along `unit`, so that a circle within $11 of the corner
// would be taken at the acceleration.
float junction2(const float unit[AXES], float mm_s2) {
  float cosine = 0.0f;  // of the angle between the reversed last direction and the new one
  for (uint8_t i = 0; i < AXES; ++i) cosine -= last_unit[i] * unit[i];
  if (cosine > 0.999999f) return 0.0f;
  if (cosine < -0.999999f) return NO_LIMIT;
  float sine_half = sqrtf(0.5f * (1.0f - cosine));
  float least = mm_s2 < last_mm_s2 ? mm_s2 : last_mm_s2;
  return least * settings::now.junction_mm * sine_half / (1.0f - sine_half);
}

}  // namespace

void clear() {
  hal::Quiet quiet;
  held = waiting = next_up = head = 0;
}

bool is_empty() { return held == 0; }

uint8_t free_blocks() { return static_cast<uint8_t>(BLOCKS - held); }

void add(const int32_t from[AXES], const int32_t to[AXES], float feed_mm_s) {
  Block& block = blocks[head];
  float unit[AXES];
  float square = 0.0f;
  for (uint8_t i = 0; i < AXES; ++i) {
    int32_t steps = to[i] - from[i];
    block.steps[i] = steps;
    unit[i] = static_cast<float>(steps) / settings::now.steps_per_mm[i];
    square += unit[i] * unit[i];
  }
  if (block.events() == 0) return;
  block.length_mm = sqrtf(square);
  block.nominal_mm_s = feed_mm_s > 0.0f ? feed_mm_s : NO_LIMIT;
  block.mm_s2 = NO_LIMIT;
  for (uint8_t i = 0; i < AXES; ++i) {
    unit[i] /= block.length_mm;
    float share = fabsf(unit[i]);
    if (share < 1e-9f) continue;
    block.nominal_mm_s = fminf(block.nominal_mm_s, settings::now.max_mm_min[i] / (60.0f * share));
    block.mm_s2 = fminf(block.mm_s2, settings::now.max_mm_s2[i] / share);
  }
  block.max_entry2 = 0.0f;
  // After a stop there is no corner: the last move is only known while its steps are still being made.
  if (!is_empty() && !stepper::is_holding()) {
    float slower = fminf(block.nominal_mm_s, last_nominal);
    block.max_entry2 = fminf(junction2(unit, block.mm_s2), slower * slower);
  }
  block.entry2 = 0.0f;
  for (uint8_t i = 0; i < AXES; ++i) last_unit[i] = unit[i];
  last_nominal = block.nominal_mm_s;
  last_mm_s2 = block.mm_s2;
  head = after(head);
  ++waiting;
  {
    hal::Quiet quiet;
    held = static_cast<uint8_t>(held + 1);
  }
  replan();
}

void replan() {
  if (waiting == 0) return;
  // The block the generator works on begins with the speed it has; everything behind it must be able to stop at the end.
  blocks[next_up].entry2 = stepper::speed_mm_s() * stepper::speed_mm_s();
  float next2 = 0.0f;
  for (uint8_t i = before(head); i != next_up; i = before(i)) {
    Block& block = blocks[i];
    next2 = fminf(block.max_entry2, next2 + 2.0f * block.mm_s2 * block.length_mm);
    block.entry2 = next2;
  }
  for (uint8_t i = next_up; after(i) != head; i = after(i)) {
    float length = i == next_up ? stepper::left_mm(blocks[i]) : blocks[i].length_mm;
    float reach2 = blocks[i].entry2 + 2.0f * blocks[i].mm_s2 * length;
    Block& following = blocks[after(i)];
    following.entry2 = fminf(following.entry2, reach2);
  }
  stepper::plan_changed();
}

Block* generating() { return waiting == 0 ? nullptr : &blocks[next_up]; }

void generated() {
  next_up = after(next_up);
  --waiting;
}

float exit2() {
  return waiting > 1 ? blocks[after(next_up)].entry2 : 0.0f;
}

Block& block_at(uint8_t index) { return blocks[index]; }

uint8_t generating_index() { return next_up; }

void release() { held = static_cast<uint8_t>(held - 1); }

}  // namespace planner
}  // namespace uvgs
