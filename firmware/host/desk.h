// The desk a simulated board stands on: its serial line as a pseudo-terminal paced by the wall clock, or as lines of
// text on stdin and stdout in lockstep with the board's own time. Shared by the native board and the AVR in simavr.
//
// Commands on stdin, in both modes; times in us since the start of the program:
//   B <t> <hex>     bytes reach the board from time t on (lockstep)
//   A <t>           let the board run until time t; answered by "O <hex of what it sent>" (lockstep)
//   Q               answered by "S <t> <motor x> <y> <z> <led duty> <trigger pulses> <motors enabled>"
//   R <cause>       reset: power, button, brown-out or watchdog
//   E <0|1>         level of the emergency-stop pin
//   C               an edge of the camera strobe
//   M <x> <y> <z>   turn the motors by so many steps behind the firmware's back
//   J               answered by "J <count> <least> <median> <most> <pulse>": cycles between steps of X since the last J, and
//                   its longest pulse, which lasts as long as the step interrupt (AVR)
#pragma once
#include <cstdint>
#include <deque>
#include <string>
#include <vector>

class Table {
 public:
  virtual ~Table() = default;
  virtual void byte_to_board(uint8_t byte, uint64_t t_us) = 0;
  virtual std::string describe(uint64_t now_us) = 0;
  virtual void set_estop(bool level) = 0;
  virtual void strobe() = 0;
  virtual void shove(int axis, int64_t steps) = 0;
  virtual std::string step_intervals() { return "0 0 0 0 0"; }
  // May throw.
  virtual void reset(const std::string& cause) = 0;
};

class Desk {
 public:
  // Options: --lockstep, or --pty with --scale X (board seconds per wall second) and --link PATH (a symbolic link to
  // the terminal). Prints the terminal's path. Unknown ones are left for the caller.
  explicit Desk(std::vector<std::string>& options);

  void sent(uint8_t byte, uint64_t t_us) { to_host_.push_back({t_us, byte}); }
  // Called when the board has run until the time given before; returns the next such time.
  uint64_t next(uint64_t now_us, Table& table);
  bool is_lockstep() const { return master_ < 0; }

 private:
  struct Sent {
    uint64_t t_us;
    uint8_t byte;
  };
  uint64_t next_lockstep(uint64_t now_us, Table& table);
  uint64_t next_terminal(uint64_t now_us, Table& table);
  void serve_terminal(int patience_ms, uint64_t now_us, Table& table);
  // Whether it was one that both modes know.
  bool obey(const std::string& command, uint64_t now_us, Table& table);
  void open_terminal(const std::string& link);

  int master_ = -1;
  double scale_ = 1.0;
  bool was_open_ = false, is_awaiting_ = false;
  uint64_t wait_until_us_ = 0, begun_wall_us_ = 0, begun_us_ = 0;
  std::string unread_;
  std::deque<Sent> to_host_;
};
