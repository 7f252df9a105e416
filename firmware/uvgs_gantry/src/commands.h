// What whole lines do: G-code, $ lines, line numbers.
#pragma once
#include "line.h"

namespace uvgs {
namespace commands {

constexpr uint8_t NO_ANSWER = 0xFF;

void forget_numbers();
// Runs a line. Returns 0 for ok, the number of an error, or NO_ANSWER.
uint8_t run_line(const LineReader& line);

}  // namespace commands
}  // namespace uvgs
