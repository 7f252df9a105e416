#include "gcode.h"

namespace uvgs {
namespace gcode {
namespace {

constexpr float MM_PER_INCH = 25.4f;

// Value words, and the axes behind them.
enum Word : uint8_t { F, N, P, S, T, FIRST_AXIS, WORDS = FIRST_AXIS + AXES };

// Words of one group exclude each other.
enum Group : uint8_t { MOTION, DWELL, PLANE, UNITS, DISTANCE, CUTTER, LENGTH, OFFSETS, MACHINE, FEED_MODE, STOP, SPINDLE, COOLANT, NONE };

Group group_of_g(uint8_t code) {
  switch (code) {
    case 0:
    case 1: return MOTION;
    case 4: return DWELL;
    case 53: return MACHINE;
    case 17: return PLANE;
    case 20:
    case 21: return UNITS;
    case 40: return CUTTER;
    case 49: return LENGTH;
    case 54: return OFFSETS;
    case 90:
    case 91: return DISTANCE;
    case 94: return FEED_MODE;
    default: return NONE;
  }
}

Group group_of_m(uint8_t code) {
  switch (code) {
    case 2:
    case 30: return STOP;
    case 3:
    case 4:
    case 5: return SPINDLE;
    case 8:
    case 9: return COOLANT;
    default: return NONE;
  }
}

uint8_t word_of(char letter) {
  switch (letter) {
    case 'F': return F;
    case 'N': return N;
    case 'P': return P;
    case 'S': return S;
    case 'T': return T;
    case 'X': return FIRST_AXIS;
    case 'Y': return FIRST_AXIS + 1;
    case 'Z': return FIRST_AXIS + 2;
    default: return WORDS;
  }
}

struct Words {
  uint16_t groups;  // bit per group
  uint16_t given;   // bit per value word
  float value[WORDS];
  bool has(uint8_t word) const { return given & (1u << word); }
  bool has_group(uint8_t group) const { return groups & (1u << group); }
};

uint8_t take_code(Words& words, Modal& modal, char letter, float value, bool is_jog) {
  if (value < 0.0f || value > 99.0f) return 20;
  uint8_t code = static_cast<uint8_t>(value);
  if (static_cast<float>(code) != value) return 20;
  Group group = letter == 'G' ? group_of_g(code) : group_of_m(code);
  if (group == NONE) return 20;
  if (is_jog && group != UNITS && group != DISTANCE && group != MACHINE) return 16;
  if (words.has_group(group)) return 21;
  words.groups |= static_cast<uint16_t>(1u << group);
  switch (group) {
    case MOTION: modal.motion = code; break;
    case UNITS: modal.is_inch = code == 20; break;
    case DISTANCE: modal.is_relative = code == 91; break;
    case SPINDLE: modal.spindle = code; break;
    case COOLANT: modal.coolant = code; break;
    default: break;
  }
  return 0;
}

uint8_t take_words(const char* text, Words& words, Modal& modal, bool is_jog) {
  words.groups = words.given = 0;
  while (*text != '\0') {
    char letter = *text++;
    if (letter < 'A' || letter > 'Z') return 1;
    float value;
    if (!read_number(text, value)) return 2;
    if (letter == 'G' || letter == 'M') {
      uint8_t error = take_code(words, modal, letter, value, is_jog);
      if (error != 0) return error;
      continue;
    }
    uint8_t word = word_of(letter);
    if (word == WORDS) return letter >= 'I' && letter <= 'L' ? 36 : letter == 'R' ? 36 : 20;
    if (words.has(word)) return 25;
    if (word < FIRST_AXIS && value < 0.0f) return 4;
    words.given |= static_cast<uint16_t>(1u << word);
    words.value[word] = value;
  }
  return 0;
}

}  // namespace

void clear(Modal& modal) { modal = Modal{0, 0, 0, 5, 9, 0, 0.0f, 0.0f}; }

bool read_number(const char*& text, float& value) {
  bool is_negative = *text == '-';
  if (*text == '-' || *text == '+') ++text;
  // Nine digits fit an integer; more do not fit a float, so they only scale.
  uint32_t digits = 0;
  int8_t exponent = 0;
  uint8_t kept = 0;
  bool has_point = false, has_digit = false;
  for (;; ++text) {
    char c = *text;
    if (c >= '0' && c <= '9') {
      has_digit = true;
      if (kept < 9) {
        digits = digits * 10 + static_cast<uint8_t>(c - '0');
        if (digits != 0) ++kept;
        if (has_point) --exponent;
      } else if (!has_point) {
        ++exponent;
      }
    } else if (c == '.' && !has_point) {
      has_point = true;
    } else {
      break;
    }
  }
  if (!has_digit) return false;
  value = static_cast<float>(digits);
  // Powers of ten up to 10 are exact in a float, so a usual number is rounded once.
  for (; exponent <= -5; exponent += 5) value /= 100000.0f;
  float scale = 1.0f;
  for (; exponent < 0; ++exponent) scale *= 10.0f;
  value /= scale;
  for (; exponent > 0; --exponent) value *= 10.0f;
  if (is_negative) value = -value;
  return true;
}

uint8_t read(const char* text, const Modal& before, const float position_mm[AXES], bool is_jog, Action& action) {
  Words words;
  Modal& modal = action.modal;
  modal = before;
  uint8_t error = take_words(text, words, modal, is_jog);
  if (error != 0) return error;
  float scale = modal.is_inch ? MM_PER_INCH : 1.0f;
  if (words.has(F)) modal.feed = words.value[F] * scale;
  if (words.has(S)) modal.rpm = words.value[S];
  if (words.has(T)) {
    if (words.value[T] > 255.0f) return 38;
    modal.tool = static_cast<uint8_t>(words.value[T]);
  }
  if (is_jog && !words.has(F)) return 22;
  action.has_dwell = words.has_group(DWELL);
  if (action.has_dwell && !words.has(P)) return 28;
  if (!action.has_dwell && words.has(P)) return 36;
  action.dwell_s = action.has_dwell ? words.value[P] : 0.0f;
  action.has_target = (words.given >> FIRST_AXIS) != 0;
  if (is_jog && !action.has_target) return 26;
  if (words.has_group(STOP)) {
    float feed = modal.feed, rpm = modal.rpm;
    uint8_t tool = modal.tool;
    clear(modal);
    modal.feed = feed;
    modal.rpm = rpm;
    modal.tool = tool;
  }
  if (!action.has_target) return 0;
  if (action.has_dwell) return 31;
  action.is_rapid = modal.motion == 0 && !is_jog;
  if (!action.is_rapid && !(modal.feed > 0.0f)) return 22;
  bool is_relative = modal.is_relative && !words.has_group(MACHINE);
  for (uint8_t i = 0; i < AXES; ++i) {
    float value = words.value[FIRST_AXIS + i] * scale;
    action.target_mm[i] = position_mm[i];
    if (!words.has(FIRST_AXIS + i)) continue;
    action.target_mm[i] = is_relative ? position_mm[i] + value : value;
  }
  return 0;
}

}  // namespace gcode
}  // namespace uvgs
