// The virtual board as a program: the whole firmware, compiled for this computer.
//
//   uvgs_board --pty [--scale X] [--link PATH]     a serial port to open with any GRBL sender
//   uvgs_board --lockstep                          for tests; see desk.h
//   both: [--switches X,Y,Z] [--memory FILE]       steps at which the switches close; a file that outlives power
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>

#include "desk.h"
#include "hal_host.h"

using virtual_board::board;

namespace {

constexpr uint64_t TICKS_PER_US = 2;

class NativeTable : public Table {
 public:
  explicit NativeTable(std::string memory_file) : memory_file_(std::move(memory_file)) {}

  void byte_to_board(uint8_t byte, uint64_t t_us) override { board.receive(byte, t_us * TICKS_PER_US); }

  std::string describe(uint64_t now_us) override {
    std::string text = std::to_string(now_us);
    for (int64_t steps : board.motor) text += " " + std::to_string(steps);
    return text + " " + std::to_string(board.led_duty) + " " + std::to_string(board.trigger_pulses.size()) + " " +
           (board.motor_level ? "0" : "1");
  }

  void set_estop(bool level) override { board.set_estop(level); }
  void strobe() override { board.strobe(); }
  void shove(int axis, int64_t steps) override { board.shove(static_cast<uint8_t>(axis), steps); }

  void reset(const std::string& cause) override {
    using uvgs::hal::ResetCause;
    throw virtual_board::HardReset{cause == "button"      ? ResetCause::button
                                   : cause == "brown-out" ? ResetCause::brown_out
                                   : cause == "watchdog"  ? ResetCause::watchdog
                                                          : ResetCause::power};
  }

  void save_memory() {
    if (memory_file_.empty() || saved_writes_ == board.memory_writes) return;
    saved_writes_ = board.memory_writes;
    std::ofstream file(memory_file_, std::ios::binary);
    file.write(reinterpret_cast<const char*>(board.memory.data()), static_cast<std::streamsize>(board.memory.size()));
  }

 private:
  std::string memory_file_;
  uint64_t saved_writes_ = 0;
};

}  // namespace

int main(int count, char** words) {
  std::vector<std::string> options(words + 1, words + count);
  std::string memory_file;
  Desk desk(options);
  for (size_t i = 0; i < options.size(); ++i) {
    bool has_value = i + 1 < options.size();
    if (options[i] == "--memory" && has_value) {
      memory_file = options[++i];
      std::ifstream file(memory_file, std::ios::binary);
      file.read(reinterpret_cast<char*>(board.memory.data()), static_cast<std::streamsize>(board.memory.size()));
    } else if (options[i] == "--switches" && has_value) {
      long long at[3];
      if (sscanf(options[++i].c_str(), "%lld,%lld,%lld", &at[0], &at[1], &at[2]) != 3) {
        std::cerr << "--switches needs three step counts, as in 3000,2000,1000" << std::endl;
        return 2;
      }
      for (int axis = 0; axis < 3; ++axis) board.switch_at[axis] = at[axis];
    } else {
      std::cerr << "unknown option: " << options[i] << std::endl;
      return 2;
    }
  }
  NativeTable table(memory_file);
  board.at_limit = [&] {
    while (!board.to_host.empty() && board.to_host.front().t <= board.now) {
      desk.sent(board.to_host.front().byte, board.to_host.front().t / TICKS_PER_US);
      board.to_host.pop_front();
    }
    table.save_memory();
    board.limit = desk.next(board.now / TICKS_PER_US, table) * TICKS_PER_US;
  };
  virtual_board::power_up();
}
