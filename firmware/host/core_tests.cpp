// Tests of the core on the virtual board: what the motors did is counted from the pins, never asked of the firmware.
// Built with sanitizers, so a stray index or an overflow fails as well. Prints one line per test; ends non-zero on a failure.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>

#include "../uvgs_gantry/src/crc.h"
#include "../uvgs_gantry/src/gcode.h"
#include "../uvgs_gantry/src/limits.h"
#include "../uvgs_gantry/src/line.h"
#include "../uvgs_gantry/src/machine.h"
#include "../uvgs_gantry/src/planner.h"
#include "../uvgs_gantry/src/serial.h"
#include "../uvgs_gantry/src/settings.h"
#include "../uvgs_gantry/src/stepper.h"
#include "hal_host.h"

using namespace uvgs;
using virtual_board::board;

namespace {

int failures;

#define CHECK(condition, ...)                                    \
  do {                                                           \
    if (!(condition)) {                                          \
      ++failures;                                                \
      printf("  %s:%d: %s: ", __FILE__, __LINE__, #condition);   \
      printf(__VA_ARGS__);                                       \
      printf("\n");                                              \
    }                                                            \
  } while (false)

struct Random {
  uint64_t state;
  uint32_t next() {
    state = state * 6364136223846793005ull + 1442695040888963407ull;
    return static_cast<uint32_t>(state >> 33);
  }
  int32_t between(int32_t low, int32_t high) {
    return low + static_cast<int32_t>(next() % static_cast<uint32_t>(high - low + 1));
  }
};

constexpr double TICKS = 2e6;  // per s

void fresh_core() {
  board = virtual_board::Board();
  board.limit = ~0ull;
  for (bool& has : board.has_switch) has = false;
  serial::init();
  stepper::init();
  planner::clear();
  settings::load();
  limits::init();
}

void set_axes(float steps_per_mm, float mm_min, float mm_s2) {
  for (uint8_t axis = 0; axis < AXES; ++axis) {
    settings::now.steps_per_mm[axis] = steps_per_mm;
    settings::now.max_mm_min[axis] = mm_min;
    settings::now.max_mm_s2[axis] = mm_s2;
  }
}

void turn() {
  stepper::prepare();
  stepper::start();
  hal::idle(false);
}

void run_to_rest() {
  while (!planner::is_empty() || stepper::is_moving()) turn();
}

void queue(int32_t target[AXES], const int32_t to[AXES], float mm_s) {
  while (planner::free_blocks() == 0) turn();
  planner::add(target, to, mm_s);
  for (uint8_t axis = 0; axis < AXES; ++axis) target[axis] = to[axis];
}

bool is_at(const int32_t target[AXES]) {
  int32_t counted[AXES];
  stepper::positions(counted);
  for (uint8_t axis = 0; axis < AXES; ++axis)
    if (board.motor[axis] != target[axis] || counted[axis] != target[axis]) return false;
  return true;
}

// --- tests ----------------------------------------------------------------------------------------------------------

void test_checksums() {
  uint16_t sum16 = CRC16_START;
  uint8_t sum8 = 0;
  for (char c : std::string("123456789")) {
    sum16 = crc16(sum16, static_cast<uint8_t>(c));
    sum8 = crc8(sum8, static_cast<uint8_t>(c));
  }
  CHECK(sum16 == 0x29B1, "%04X", sum16);
  CHECK(sum8 == 0xF4, "%02X", sum8);
}

void test_numbers() {
  struct Case { const char* text; bool is_number; float value; const char* rest; };
  const Case cases[] = {{"1.5X", true, 1.5f, "X"},     {"-0.001", true, -0.001f, ""}, {"+20", true, 20.0f, ""},
                        {".5", true, 0.5f, ""},        {"5.", true, 5.0f, ""},        {".", false, 0, ""},
                        {"-", false, 0, ""},           {"", false, 0, ""},            {"1.2.3", true, 1.2f, ".3"},
                        {"123.4567890123", true, 123.456789f, ""},                    {"0.0000001", true, 1e-7f, ""},
                        {"12345678901", true, 12345678901.0f, ""}};
  for (const Case& c : cases) {
    const char* text = c.text;
    float value = 0.0f;
    bool is_number = gcode::read_number(text, value);
    CHECK(is_number == c.is_number, "%s", c.text);
    if (!is_number) continue;
    CHECK(std::fabs(value - c.value) <= 1e-6f * std::fabs(c.value), "%s gave %g", c.text, static_cast<double>(value));
    CHECK(strcmp(text, c.rest) == 0, "%s left %s", c.text, text);
  }
}

// Every queue of moves ends on its exact step, whatever the corners, and never faster than allowed.
void test_steps_are_exact() {
  Random random{1};
  for (int round = 0; round < 40; ++round) {
    fresh_core();
    float steps_per_mm = static_cast<float>(random.between(20, 400));
    float mm_s = static_cast<float>(random.between(1, 30));
    set_axes(steps_per_mm, mm_s * 60.0f, static_cast<float>(random.between(10, 1000)));
    virtual_board::Ticks last[AXES] = {0, 0, 0}, closest = ~0ull;
    board.on_step = [&](const virtual_board::StepEvent& event) {
      for (uint8_t axis = 0; axis < AXES; ++axis) {
        if (!(event.axes & (1 << axis))) continue;
        if (last[axis] != 0 && event.t - last[axis] < closest) closest = event.t - last[axis];
        last[axis] = event.t;
      }
    };
    int32_t target[AXES] = {0, 0, 0};
    for (int move = 0; move < 30; ++move) {
      int32_t reach = random.between(0, 9) == 0 ? 3 : 2000;
      int32_t to[AXES];
      for (uint8_t axis = 0; axis < AXES; ++axis)
        to[axis] = target[axis] + (random.between(0, 3) == 0 ? 0 : random.between(-reach, reach));
      queue(target, to, static_cast<float>(random.between(1, 40)));
    }
    run_to_rest();
    CHECK(is_at(target), "round %d: motors at %lld %lld %lld", round, static_cast<long long>(board.motor[0]),
          static_cast<long long>(board.motor[1]), static_cast<long long>(board.motor[2]));
    // The axes with fewer steps get theirs on the nearest eighth, half or whole step of the axis with most.
    double allowed = TICKS / (static_cast<double>(steps_per_mm) * static_cast<double>(mm_s));
    CHECK(static_cast<double>(closest) >= 0.49 * allowed, "round %d: %g of %g ticks", round,
          static_cast<double>(closest), allowed);
    CHECK(stepper::underruns() == 0, "round %d: ran dry", round);
  }
}

// One axis from rest to rest follows the trapezoid of its limits.
void test_trapezoid() {
  Random random{2};
  double worst_steps = 0.0, worst_speed = 0.0, worst_acceleration = 0.0, worst_time = 0.0;
  for (int round = 0; round < 30; ++round) {
    fresh_core();
    double steps_per_mm = random.between(50, 400), mm_s = random.between(2, 30), mm_s2 = random.between(20, 1000);
    set_axes(static_cast<float>(steps_per_mm), static_cast<float>(mm_s * 60.0), static_cast<float>(mm_s2));
    double mm = random.between(2, 60);
    int32_t steps = static_cast<int32_t>(mm * steps_per_mm);
    mm = steps / steps_per_mm;
    double top = std::fmin(mm_s, std::sqrt(mm * mm_s2)), ramp_s = top / mm_s2, ramp_mm = 0.5 * top * ramp_s;
    double cruise_s = (mm - 2.0 * ramp_mm) / top, total_s = 2.0 * ramp_s + cruise_s;
    auto ideal = [&](double s) {
      if (s <= 0.0) return 0.0;
      if (s < ramp_s) return 0.5 * mm_s2 * s * s;
      if (s < ramp_s + cruise_s) return ramp_mm + top * (s - ramp_s);
      if (s < total_s) return mm - 0.5 * mm_s2 * (total_s - s) * (total_s - s);
      return mm;
    };
    std::vector<double> times;
    board.on_step = [&](const virtual_board::StepEvent& event) { times.push_back(static_cast<double>(event.t) / TICKS); };
    int32_t target[AXES] = {0, 0, 0};
    const int32_t to[AXES] = {0, steps, 0};
    double begun = static_cast<double>(board.now) / TICKS;
    queue(target, to, 0.0f);
    run_to_rest();
    CHECK(is_at(target), "round %d", round);
    CHECK(static_cast<int32_t>(times.size()) == steps, "%zu of %d", times.size(), steps);
    for (size_t k = 0; k < times.size(); ++k) {
      double error = std::fabs(ideal(times[k] - begun) * steps_per_mm - static_cast<double>(k + 1));
      worst_steps = std::fmax(worst_steps, error / (1.0 + 0.005 * top * steps_per_mm));
      if (k == 0) continue;
      worst_speed = std::fmax(worst_speed, 1.0 / ((times[k] - times[k - 1]) * steps_per_mm) / mm_s);
    }
    // Speeds of neighbouring windows of 20 ms at least and 20 steps.
    size_t window = static_cast<size_t>(std::fmax(20.0, 0.02 * top * steps_per_mm));
    for (size_t k = 2 * window; k < times.size(); k += window) {
      double first = static_cast<double>(window) / (times[k - window] - times[k - 2 * window]);
      double second = static_cast<double>(window) / (times[k] - times[k - window]);
      double acceleration = std::fabs(second - first) / steps_per_mm / (0.5 * (times[k] - times[k - 2 * window]));
      worst_acceleration = std::fmax(worst_acceleration, acceleration / mm_s2);
    }
    worst_time = std::fmax(worst_time, std::fabs(times.back() - begun - total_s));
  }
  printf("  place off by %.2f of (1 step + 5 ms of speed), speed %.4f and acceleration %.3f of what is allowed, end off by %.1f ms\n",
         worst_steps, worst_speed, worst_acceleration, 1e3 * worst_time);
  // Segments of 5 ms have one speed, and the first step waits for 0.1 ms: hence steps, not fractions. An interval is whole
  // ticks, of which the fastest steps here have 166.
  CHECK(worst_steps < 1.5, "%g", worst_steps);
  CHECK(worst_speed < 1.006, "%g", worst_speed);
  CHECK(worst_acceleration < 1.15, "%g", worst_acceleration);
  CHECK(worst_time < 0.03, "%g s", worst_time);
}

void test_ten_million_steps() {
  fresh_core();
  set_axes(400.0f, 2250.0f, 1000.0f);
  Random random{3};
  int64_t made[AXES] = {0, 0, 0}, wanted[AXES] = {0, 0, 0};
  board.on_step = [&](const virtual_board::StepEvent& event) {
    for (uint8_t axis = 0; axis < AXES; ++axis) made[axis] += event.axes >> axis & 1;
  };
  int32_t target[AXES] = {0, 0, 0};
  while (wanted[0] + wanted[1] + wanted[2] < 10000000) {
    int32_t to[AXES];
    for (uint8_t axis = 0; axis < AXES; ++axis) {
      to[axis] = random.between(-200000, 200000);
      wanted[axis] += std::abs(to[axis] - target[axis]);
    }
    queue(target, to, 0.0f);
  }
  run_to_rest();
  long long lost = 0;
  for (uint8_t axis = 0; axis < AXES; ++axis) lost += std::llabs(wanted[axis] - made[axis]);
  printf("  %lld steps, %lld lost, ran dry %u times\n", static_cast<long long>(made[0] + made[1] + made[2]), lost,
         stepper::underruns());
  CHECK(lost == 0 && is_at(target) && stepper::underruns() == 0, "%lld", lost);
}

void test_parser_takes_anything() {
  Random random{4};
  const std::string letters = "GGGMXYZFSPNT$J=0123456789.-+ */;()#~abcxyz";
  gcode::Modal modal;
  gcode::clear(modal);
  const float here[AXES] = {1.0f, 2.0f, 3.0f};
  long accepted = 0;
  for (int round = 0; round < 200000; ++round) {
    LineReader reader;
    reader.clear();
    int length = random.between(0, 100);
    for (int i = 0; i < length; ++i) {
      bool is_wild = random.between(0, 19) == 0;
      char c = is_wild ? static_cast<char>(random.between(1, 127))
                       : letters[static_cast<size_t>(random.between(0, static_cast<int>(letters.size()) - 1))];
      if (c != '\r' && c != '\n') reader.push(c);
    }
    CHECK(reader.push('\n'), "a line end ends a line");
    CHECK(strlen(reader.text()) <= LineReader::LONGEST, "%zu", strlen(reader.text()));
    gcode::Action action;
    uint8_t code = gcode::read(reader.text(), modal, here, round % 2 == 0, action);
    accepted += code == 0;
    CHECK(code <= 38, "%s gave %d", reader.text(), code);
  }
  CHECK(accepted > 100, "only %ld were accepted: the fuzz says nothing", accepted);
}

struct Done {};

// Random bytes, real-time ones among them, at the whole firmware: it must still greet after a reset at the end, and the
// motors must be where it says.
void test_machine_survives_noise() {
  for (uint64_t seed = 1; seed <= 10; ++seed) {
    Random random{seed};
    board = virtual_board::Board();
    const std::string useful[] = {"G91 X1 F300\n", "$J=G91 Y-1 F200\n", "$H\n", "$X\n", "!", "~", "?", "\x85", "\xF0", "\x18",
                                  "$22=1\n", "$20=1\n", "M3 S500\n", "G4 P0.01\n", "$M=G90X-1F100\n", "$T\n", "$L\n", "G0 X-999\n"};
    int sent = 0;
    std::string heard;
    board.at_limit = [&] {
      board.limit += 40000;
      while (!board.to_host.empty()) {
        heard += static_cast<char>(board.to_host.front().byte);
        board.to_host.pop_front();
      }
      if (++sent < 1500) {
        if (random.between(0, 3) == 0) {
          board.receive(static_cast<uint8_t>(random.between(0, 255)), board.now);
        } else {
          for (char c : useful[random.between(0, 17)]) board.receive(static_cast<uint8_t>(c), board.now);
        }
      } else if (sent == 1500) {
        board.receive(0x18, board.now);
      } else if (sent == 1600) {
        heard.clear();
        board.receive(0x18, board.now);
      } else if (sent == 1700) {
        throw Done();
      }
    };
    try {
      virtual_board::power_up();
    } catch (const Done&) {
    }
    CHECK(heard.find("Grbl 1.1h") != std::string::npos, "seed %llu", static_cast<unsigned long long>(seed));
    int32_t counted[AXES];
    stepper::positions(counted);
    // Homing gives the counters a new origin; between two homings they move with the motors.
    CHECK(!stepper::is_moving(), "seed %llu", static_cast<unsigned long long>(seed));
  }
}

// A power cut at any byte of a write leaves the old settings or the new ones, never a mixture, never none.
void test_settings_outlive_a_cut() {
  board = virtual_board::Board();
  board.limit = ~0ull;
  settings::load();
  while (settings::is_writing()) hal::idle(true);
  settings::set(100, 300.0f);
  settings::set(22, 1.0f);
  while (settings::is_writing()) hal::idle(true);
  std::vector<uint8_t> before = board.memory;
  settings::set(100, 400.0f);
  int writes = 0, olds = 0, news = 0;
  while (settings::is_writing()) {
    uint64_t count = board.memory_writes;
    hal::idle(true);
    if (board.memory_writes == count) continue;
    ++writes;
    std::vector<uint8_t> cut = board.memory;
    Settings running = settings::now;
    bool is_whole = settings::load();
    CHECK(is_whole && settings::now.homing == 1, "after %d bytes", writes);
    olds += settings::now.steps_per_mm[0] == 300.0f;
    news += settings::now.steps_per_mm[0] == 400.0f;
    // Back to the moment before the cut, and one byte further.
    board.memory = before;
    settings::load();
    while (settings::is_writing()) hal::idle(true);
    before = board.memory;
    settings::set(100, 400.0f);
    (void)running;
    for (int i = 0; i < writes && settings::is_writing();) {
      count = board.memory_writes;
      hal::idle(true);
      i += board.memory_writes != count;
    }
  }
  CHECK(writes >= 4, "%d bytes were written", writes);
  CHECK(olds + news == writes && olds >= 1, "%d old and %d new of %d", olds, news, writes);
}

struct Test {
  const char* name;
  void (*run)();
};

const Test TESTS[] = {
    {"checksums", test_checksums},
    {"numbers", test_numbers},
    {"steps are exact", test_steps_are_exact},
    {"trapezoid", test_trapezoid},
    {"ten million steps", test_ten_million_steps},
    {"the parser takes anything", test_parser_takes_anything},
    {"the machine survives noise", test_machine_survives_noise},
    {"settings outlive a cut", test_settings_outlive_a_cut},
};

}  // namespace

int main() {
  int passed = 0, failed = 0;
  for (const Test& test : TESTS) {
    int before = failures;
    test.run();
    bool is_good = failures == before;
    printf("%s %s\n", is_good ? "ok  " : "FAIL", test.name);
    ++(is_good ? passed : failed);
  }
  printf("%d passed, %d failed\n", passed, failed);
  return failed == 0 ? 0 : 1;
}
