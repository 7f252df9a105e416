// A queue of straight moves with look-ahead: speeds at junctions as high as the junction deviation ($11), the
// accelerations and the rest of the queue allow, always able to stop at the end.
#pragma once
#include "hal.h"

namespace uvgs {
namespace planner {

constexpr uint8_t BLOCKS = 15;

struct Block {
  int32_t steps[AXES];
  float length_mm;           // of the whole move
  float entry2, max_entry2;  // squared speeds, mm2/s2
  float nominal_mm_s, mm_s2;

  uint32_t count(uint8_t axis) const {
    return static_cast<uint32_t>(steps[axis] < 0 ? -steps[axis] : steps[axis]);
  }
  // Steps of the axis that has most: the events the interrupt counts.
  uint32_t events() const {
    uint32_t most = 0;
    for (uint8_t i = 0; i < AXES; ++i) most = count(i) > most ? count(i) : most;
    return most;
  }
  uint8_t negative() const {
    uint8_t axes = 0;
    for (uint8_t i = 0; i < AXES; ++i)
      if (steps[i] < 0) axes |= static_cast<uint8_t>(1 << i);
    return axes;
  }
};
static_assert(BLOCKS <= 16, "a segment keeps the index of its block in four bits");

void clear();
bool is_empty();
uint8_t free_blocks();

// Queue a move. Args: from, to: step counters; feed in mm/s along the path, or 0 for as fast as possible.
// A move of no length queues nothing. There must be a free block.
void add(const int32_t from[AXES], const int32_t to[AXES], float feed_mm_s);

// For the segment generator: the block to work on next, or null; done with it; its exit speed squared.
Block* generating();
void generated();
float exit2();
// Plan again from the generator's present speed, after a hold.
void replan();

// For the step interrupt, which frees a block when its last step is out.
Block& block_at(uint8_t index);
uint8_t generating_index();
void release();

}  // namespace planner
}  // namespace uvgs
