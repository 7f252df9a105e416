// Steps. The main program cuts the planned moves into short segments of constant rate; the timer interrupt makes the
// steps of a segment, all axes in step with the one that has most (Bresenham), and counts every pulse it puts out.
#pragma once
#include "hal.h"
#include "planner.h"

namespace uvgs {
namespace stepper {

void init();

// --- main program ---
// Fill the ring of segments. Called whenever the main program has a moment, at least every 20 ms while moving.
void prepare();
bool needs_preparing();
// Begin moving when segments are there.
void start();
// Brake to a stop inside whatever is planned; has_stopped() then, with the rest of the plan kept.
void hold();
bool is_holding();
bool has_stopped();
// Go on after a stop.
void resume();
// Forget what was cut but not made; the planner must be cleared too.
void discard();
bool is_moving();
Instant rested_since();
void positions(int32_t out[AXES]);
void set_positions(const int32_t steps[AXES]);
float speed_mm_s();                          // of the segment cut last
float left_mm(const planner::Block& block);  // of the block being cut
void plan_changed();
uint16_t underruns();                        // times the ring ran dry in a move
// While homing: axes in the mask stop at once when their switch closes.
void lock_on_limit(uint8_t axes);
uint8_t locked();
void apply_settings();

// --- interrupts ---
void on_timer();
void kill();                                 // no step after this one; also callable from the main program
void lock(uint8_t axes);
int32_t position_in_interrupt(uint8_t axis);
bool is_moving_in_interrupt();
uint8_t lock_mask_in_interrupt();

}  // namespace stepper
}  // namespace uvgs
