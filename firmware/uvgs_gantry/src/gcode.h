// Reads one line of G-code, or the words of a jog, and says what it asks for. Nothing is done here.
#pragma once
#include "hal.h"

namespace uvgs {
namespace gcode {

// What is remembered between lines. Feed in mm/min.
struct Modal {
  uint8_t motion;     // 0 or 1
  uint8_t is_inch, is_relative;
  uint8_t spindle;    // 3, 4 or 5, as in M3
  uint8_t coolant;    // 8 or 9
  uint8_t tool;
  float feed, rpm;
};

struct Action {
  Modal modal;        // after the line
  bool has_target, has_dwell, is_rapid;
  float target_mm[AXES];
  float dwell_s;
};

void clear(Modal& modal);

// Args: text: upper case, no blanks; modal: before the line; position_mm: where the line starts from.
// is_jog: the rules of $J=: a feed of its own, few words. Returns 0 or the number of the error.
uint8_t read(const char* text, const Modal& modal, const float position_mm[AXES], bool is_jog, Action& action);

// A decimal number without exponent; moves the text on. False when there is none.
bool read_number(const char*& text, float& value);

}  // namespace gcode
}  // namespace uvgs
