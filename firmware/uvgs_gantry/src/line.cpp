#include "line.h"

#include "crc.h"

namespace uvgs {
namespace {

// star_digits_: 0 no star yet, 1 star seen, 2 and 3 digits taken.
constexpr uint8_t STAR = 1, WHOLE = 3;

int8_t digit_of(char c) {
  if (c >= '0' && c <= '9') return static_cast<int8_t>(c - '0');
  if (c >= 'A' && c <= 'F') return static_cast<int8_t>(c - 'A' + 10);
  return -1;
}

}  // namespace

void LineReader::clear() {
  length_ = 0;
  comment_ = '\0';
  is_complete_ = false;
  fault_ = Fault::none;
  sum_ = given_ = star_digits_ = 0;
  text_[0] = '\0';
}

bool LineReader::push(char c) {
  if (is_complete_) clear();
  if (c == '\r' || c == '\n') {
    text_[length_] = '\0';
    if (star_digits_ > 0 && fault_ == Fault::none && (star_digits_ != WHOLE || given_ != sum_))
      fault_ = Fault::bad_checksum;
    is_complete_ = true;
    return true;
  }
  if (c >= 'a' && c <= 'z' && star_digits_ > 0) c = static_cast<char>(c - 'a' + 'A');
  if (star_digits_ > 0) {
    int8_t digit = digit_of(c);
    if (digit >= 0 && star_digits_ < WHOLE) {
      given_ = static_cast<uint8_t>((given_ << 4) | digit);
      ++star_digits_;
    } else if (c > ' ') {
      star_digits_ = WHOLE + 1;
    }
    return false;
  }
  if (c == '*' && comment_ == '\0') {
    star_digits_ = STAR;
    return false;
  }
  sum_ = crc8(sum_, static_cast<uint8_t>(c));
  if (comment_ != '\0') {
    if (comment_ == '(' && c == ')') comment_ = '\0';
  } else if (c == '(' || c == ';') {
    comment_ = c;
  } else if (c > ' ' && c != '/') {
    if (length_ >= LONGEST) {
      fault_ = Fault::too_long;
    } else {
      text_[length_++] = c >= 'a' && c <= 'z' ? static_cast<char>(c - 'a' + 'A') : c;
    }
  }
  return false;
}

}  // namespace uvgs
