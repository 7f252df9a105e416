// Assembles lines as GRBL does: blanks and comments do not count, letters become upper case, CR and LF each end a line.
// A checksum behind '*' is verified over all characters as they came.
#pragma once
#include <stdint.h>

namespace uvgs {

class LineReader {
 public:
  static constexpr uint8_t LONGEST = 79;

  enum class Fault : uint8_t { none, too_long, bad_checksum };

  void clear();
  // Takes a character; true when a line has ended and can be read until the next push.
  bool push(char character);

  const char* text() const { return text_; }
  Fault fault() const { return fault_; }
  bool has_checksum() const { return star_digits_ > 0; }

 private:
  char text_[LONGEST + 1];
  uint8_t length_ = 0;
  char comment_ = '\0';
  bool is_complete_ = false;
  Fault fault_ = Fault::none;
  uint8_t sum_ = 0, given_ = 0, star_digits_ = 0;
};

}  // namespace uvgs
