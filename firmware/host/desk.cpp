#include "desk.h"

#include <fcntl.h>
#include <poll.h>
#include <stdlib.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include <cstdio>
#include <iostream>
#include <sstream>

namespace {

constexpr uint64_t QUANTUM_US = 500;
// Time a boot loader takes after the port was opened; what is sent meanwhile is lost.
constexpr uint64_t BOOT_LOADER_US = 200000;

uint64_t wall_us() {
  timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return static_cast<uint64_t>(t.tv_sec) * 1000000u + static_cast<uint64_t>(t.tv_nsec) / 1000u;
}

[[noreturn]] void fail(const std::string& why) {
  std::cerr << why << std::endl;
  exit(2);
}

void tell(const std::string& line) { std::cout << line << std::endl; }

}  // namespace

Desk::Desk(std::vector<std::string>& options) {
  std::vector<std::string> others;
  std::string link;
  bool has_terminal = false, has_lockstep = false;
  for (size_t i = 0; i < options.size(); ++i) {
    const std::string& option = options[i];
    bool has_value = i + 1 < options.size();
    if (option == "--lockstep") {
      has_lockstep = true;
    } else if (option == "--pty") {
      has_terminal = true;
    } else if (option == "--scale" && has_value) {
      scale_ = atof(options[++i].c_str());
      if (!(scale_ > 0.0)) fail("--scale needs a number above 0");
    } else if (option == "--link" && has_value) {
      link = options[++i];
    } else {
      others.push_back(option);
    }
  }
  options = others;
  if (has_lockstep == has_terminal) fail("choose one: --lockstep, or --pty [--scale X] [--link PATH]");
  if (has_terminal) open_terminal(link);
}

void Desk::open_terminal(const std::string& link) {
  master_ = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
  if (master_ < 0 || grantpt(master_) != 0 || unlockpt(master_) != 0) fail("no pseudo-terminal");
  termios settings;
  tcgetattr(master_, &settings);
  cfmakeraw(&settings);
  tcsetattr(master_, TCSANOW, &settings);
  std::string name = ptsname(master_);
  // Opened and closed once, so that from now on the master tells when nobody holds the terminal.
  close(open(name.c_str(), O_RDWR | O_NOCTTY));
  if (!link.empty()) {
    unlink(link.c_str());
    if (symlink(name.c_str(), link.c_str()) != 0) fail("cannot make the link " + link);
  }
  tell(name);
  begun_wall_us_ = wall_us();
}

uint64_t Desk::next(uint64_t now_us, Table& table) {
  return master_ < 0 ? next_lockstep(now_us, table) : next_terminal(now_us, table);
}

bool Desk::obey(const std::string& command, uint64_t now_us, Table& table) {
  std::istringstream words(command);
  std::string verb;
  words >> verb;
  if (verb == "Q") {
    tell("S " + table.describe(now_us));
  } else if (verb == "R") {
    std::string cause;
    words >> cause;
    table.reset(cause);
  } else if (verb == "E") {
    int level = 0;
    words >> level;
    table.set_estop(level != 0);
  } else if (verb == "J") {
    tell("J " + table.step_intervals());
  } else if (verb == "C") {
    table.strobe();
  } else if (verb == "M") {
    for (int axis = 0; axis < 3; ++axis) {
      int64_t steps = 0;
      words >> steps;
      table.shove(axis, steps);
    }
  } else {
    return false;
  }
  return true;
}

uint64_t Desk::next_lockstep(uint64_t now_us, Table& table) {
  if (is_awaiting_ && now_us >= wait_until_us_) {
    std::string reply = "O ";
    char digits[3];
    while (!to_host_.empty() && to_host_.front().t_us <= now_us) {
      snprintf(digits, sizeof digits, "%02X", to_host_.front().byte);
      reply += digits;
      to_host_.pop_front();
    }
    tell(reply);
    is_awaiting_ = false;
  }
  if (is_awaiting_) return wait_until_us_;
  std::string command;
  while (std::getline(std::cin, command)) {
    std::istringstream words(command);
    std::string verb, bytes;
    uint64_t t_us = 0;
    words >> verb;
    if (verb == "B") {
      words >> t_us >> bytes;
      for (size_t i = 0; i + 1 < bytes.size(); i += 2)
        table.byte_to_board(static_cast<uint8_t>(strtoul(bytes.substr(i, 2).c_str(), nullptr, 16)), t_us);
    } else if (verb == "A") {
      words >> t_us;
      wait_until_us_ = t_us > now_us ? t_us : now_us;
      is_awaiting_ = true;
      return wait_until_us_ > now_us ? wait_until_us_ : next_lockstep(now_us, table);
    } else if (!obey(command, now_us, table)) {
      fail("unknown command: " + command);
    }
  }
  exit(0);
}

uint64_t Desk::next_terminal(uint64_t now_us, Table& table) {
  uint64_t wall = wall_us();
  uint64_t due_us = begun_wall_us_ + static_cast<uint64_t>(static_cast<double>(now_us - begun_us_) / scale_);
  if (wall > due_us + 100000) {
    // The machine is busier than the board: board time runs slower, it does not jump.
    begun_wall_us_ = wall;
    begun_us_ = now_us;
  }
  do {
    wall = wall_us();
    int patience_ms = wall + 1000 < due_us ? static_cast<int>((due_us - wall) / 1000) : 0;
    serve_terminal(patience_ms, now_us, table);
  } while (wall_us() + 1000 < due_us);
  uint64_t step = scale_ > 1.0 ? static_cast<uint64_t>(static_cast<double>(QUANTUM_US) * scale_) : QUANTUM_US;
  return now_us + step;
}

void Desk::serve_terminal(int patience_ms, uint64_t now_us, Table& table) {
  pollfd ends[2] = {{master_, POLLIN, 0}, {0, POLLIN, 0}};
  poll(ends, 2, patience_ms);
  if (ends[1].revents & (POLLIN | POLLHUP)) {
    char buffer[256];
    ssize_t count = read(0, buffer, sizeof buffer);
    if (count <= 0) exit(0);
    unread_.append(buffer, static_cast<size_t>(count));
    for (size_t end; (end = unread_.find('\n')) != std::string::npos;) {
      std::string command = unread_.substr(0, end);
      unread_.erase(0, end + 1);
      if (!obey(command, now_us, table)) fail("unknown command: " + command);
    }
  }
  bool is_open = !(ends[0].revents & POLLHUP);
  if (is_open && !was_open_) {
    was_open_ = true;
    to_host_.clear();
    usleep(static_cast<useconds_t>(static_cast<double>(BOOT_LOADER_US) / scale_));
    uint8_t lost[256];
    while (read(master_, lost, sizeof lost) > 0) {
    }
    begun_wall_us_ = wall_us();
    begun_us_ = now_us;
    table.reset("button");
    return;
  }
  was_open_ = is_open;
  if (ends[0].revents & POLLIN) {
    uint8_t buffer[64];
    ssize_t count = read(master_, buffer, sizeof buffer);
    for (ssize_t i = 0; i < count; ++i) table.byte_to_board(buffer[i], now_us);
  }
  while (!to_host_.empty() && to_host_.front().t_us <= now_us) {
    if (is_open && write(master_, &to_host_.front().byte, 1) != 1) break;
    to_host_.pop_front();
  }
  // A closed terminal is asked again and again; without a pause that would be all this process does.
  if (!is_open && patience_ms > 0) usleep(static_cast<useconds_t>(patience_ms) * 1000);
}
