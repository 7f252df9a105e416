// Carries the compiled AVR firmware in simavr: its serial line on the desk, its pins wired to counted motors, limit
// switches, an emergency stop and a camera strobe. Positions are counted here from the step and direction pins.
//
//   avr_runner ELF --pty | --lockstep [--switches X,Y,Z] [--memory FILE]
#include <stdarg.h>
#include <sys/types.h>

extern "C" {
#include <simavr/avr_acomp.h>
#include <simavr/avr_eeprom.h>
#include <simavr/avr_extint.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
}

#include <algorithm>
#include <cstdio>
#include <cstring>
#include <deque>
#include <fstream>
#include <iostream>

#include "../host/desk.h"

namespace {

constexpr uint64_t CYCLES_PER_US = 16;
constexpr uint64_t BYTE_CYCLES = 87 * CYCLES_PER_US;
constexpr int AXES = 3;
constexpr int STEP_PINS[AXES] = {2, 3, 4}, DIRECTION_PINS[AXES] = {5, 6, 7}, LIMIT_PINS[AXES] = {1, 2, 4};
constexpr int ENABLE_PIN = 0, LED_PIN = 3, ESTOP_PIN = 0, TRIGGER_PIN = 3;
// Data addresses of registers.
constexpr int PORTB_AT = 0x25, MCUSR_AT = 0x54, TCCR2A_AT = 0xB0, OCR2A_AT = 0xB3;
constexpr int MEMORY_BYTES = 1024;

class AvrTable : public Table {
 public:
  AvrTable(const std::string& elf, std::string memory_file) : memory_file_(std::move(memory_file)) {
    elf_firmware_t firmware;
    memset(&firmware, 0, sizeof firmware);
    if (elf_read_firmware(elf.c_str(), &firmware) != 0) {
      std::cerr << elf << ": cannot be read as an AVR program" << std::endl;
      exit(2);
    }
    avr_ = avr_make_mcu_by_name("atmega328p");
    avr_init(avr_);
    avr_->frequency = 16000000;
    avr_load_firmware(avr_, &firmware);
    // Time is paced by the desk; a sleeping processor must not also sleep here.
    avr_->sleep = [](avr_t*, avr_cycle_count_t) {};
    // The step pins could be external interrupts of a level, which the simulator would ask for at every cycle.
    for (uint8_t pin = 0; pin < 2; ++pin) avr_extint_set_strict_lvl_trig(avr_, pin, 0);
    uint32_t flags = 0;
    avr_ioctl(avr_, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~static_cast<uint32_t>(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POOL_SLEEP);
    avr_ioctl(avr_, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    wire();
    load_memory();
    set_inputs();
    set_cause("power");
  }

  uint64_t now_us() const { return cycle_now() / CYCLES_PER_US; }

  // The end and every arriving byte are timers of the simulator: a sleeping processor goes from one to the next.
  void run_until(uint64_t t_us) {
    if (t_us <= now_us()) return;
    has_ended_ = false;
    at_cycle(t_us * CYCLES_PER_US, [](avr_t* avr, avr_cycle_count_t, void* table) -> avr_cycle_count_t {
      static_cast<AvrTable*>(table)->has_ended_ = true;
      // Asleep it would go on to the next timer at once; awake it looks around and sleeps again.
      if (avr->state == cpu_Sleeping) avr->state = cpu_Running;
      return 0;
    });
    if (!arriving_.empty()) at_cycle(arriving_.front().first, deliver);
    while (!has_ended_) {
      int state = avr_run(avr_);
      if (state == cpu_Done || state == cpu_Crashed) {
        std::cerr << "the firmware crashed" << std::endl;
        exit(3);
      }
    }
  }

  // What the board sent since the last call.
  template <typename Take>
  void take_sent(Take take) {
    for (const auto& sent : sent_) take(sent.second, sent.first);
    sent_.clear();
  }

  void byte_to_board(uint8_t byte, uint64_t t_us) override {
    uint64_t t = std::max(t_us, now_us()) * CYCLES_PER_US;
    if (!arriving_.empty()) t = std::max(t, arriving_.back().first + BYTE_CYCLES);
    arriving_.push_back({t, byte});
  }

  std::string describe(uint64_t now_us) override {
    std::string text = std::to_string(now_us);
    for (int64_t steps : motor_) text += " " + std::to_string(steps);
    bool is_dimmed = avr_->data[TCCR2A_AT] & 0x80;
    int led = is_dimmed ? avr_->data[OCR2A_AT] : (avr_->data[PORTB_AT] >> LED_PIN & 1) * 255;
    bool is_on = !(avr_->data[PORTB_AT] >> ENABLE_PIN & 1);
    return text + " " + std::to_string(led) + " " + std::to_string(trigger_pulses_) + " " + (is_on ? "1" : "0");
  }

  void set_estop(bool level) override {
    estop_ = level;
    set_inputs();
  }

  void strobe() override {
    strobe_ = !strobe_;
    set_inputs();
  }

  void shove(int axis, int64_t steps) override {
    motor_[axis] += steps;
    set_inputs();
  }

  void reset(const std::string& cause) override {
    before_us_ = now_us();
    save_memory();
    avr_reset(avr_);
    avr_->cycle = 0;
    arriving_.clear();
    sent_.clear();
    last_x_step_ = 0;
    set_cause(cause);
    // The reset forgot what stands on the inputs; only changes are passed on, so each is changed there and back.
    for (int axis = 0; axis < AXES; ++axis) {
      avr_raise_irq(avr_io_getirq(avr_, AVR_IOCTL_IOPORT_GETIRQ('B'), LIMIT_PINS[axis]), !limit_level_[axis]);
      limit_level_[axis] = -1;
    }
    avr_raise_irq(avr_io_getirq(avr_, AVR_IOCTL_IOPORT_GETIRQ('C'), ESTOP_PIN), !estop_);
    set_inputs();
  }

  std::string step_intervals() override {
    std::vector<uint64_t> sorted = intervals_;
    uint64_t pulse = longest_pulse_;
    intervals_.clear();
    longest_pulse_ = 0;
    if (sorted.empty()) return "0 0 0 0 0";
    std::sort(sorted.begin(), sorted.end());
    return std::to_string(sorted.size()) + " " + std::to_string(sorted.front()) + " " +
           std::to_string(sorted[sorted.size() / 2]) + " " + std::to_string(sorted.back()) + " " +
           std::to_string(pulse);
  }

  void save_memory() {
    if (memory_file_.empty()) return;
    std::vector<uint8_t> bytes(MEMORY_BYTES);
    avr_eeprom_desc_t memory = {bytes.data(), 0, MEMORY_BYTES};
    avr_ioctl(avr_, AVR_IOCTL_EEPROM_GET, &memory);
    if (bytes == saved_) return;
    saved_ = bytes;
    std::ofstream file(memory_file_, std::ios::binary);
    file.write(reinterpret_cast<const char*>(bytes.data()), MEMORY_BYTES);
  }

  int64_t switch_at[AXES] = {3000, 2000, 1000};

  void set_inputs() {
    for (int axis = 0; axis < AXES; ++axis) {
      bool is_closed = motor_[axis] >= switch_at[axis];
      if (limit_level_[axis] == !is_closed) continue;
      limit_level_[axis] = !is_closed;
      avr_raise_irq(avr_io_getirq(avr_, AVR_IOCTL_IOPORT_GETIRQ('B'), LIMIT_PINS[axis]), !is_closed);
    }
    avr_raise_irq(avr_io_getirq(avr_, AVR_IOCTL_IOPORT_GETIRQ('C'), ESTOP_PIN), estop_);
    avr_raise_irq(avr_io_getirq(avr_, AVR_IOCTL_ACOMP_GETIRQ, ACOMP_IRQ_ADC5), strobe_ ? 5000 : 0);
  }

 private:
  void wire() {
    for (int axis = 0; axis < AXES; ++axis) {
      step_wires_[axis] = {this, axis};
      avr_irq_register_notify(
          avr_io_getirq(avr_, AVR_IOCTL_IOPORT_GETIRQ('D'), STEP_PINS[axis]),
          [](avr_irq_t* irq, uint32_t level, void* wire) {
            auto* w = static_cast<StepWire*>(wire);
            if (level && !irq->value) w->table->on_step(w->axis);
            if (!level && irq->value) w->table->on_step_end();
          },
          &step_wires_[axis]);
    }
    avr_irq_register_notify(
        avr_io_getirq(avr_, AVR_IOCTL_IOPORT_GETIRQ('C'), TRIGGER_PIN),
        [](avr_irq_t* irq, uint32_t level, void* table) {
          if (level && !irq->value) ++static_cast<AvrTable*>(table)->trigger_pulses_;
        },
        this);
    avr_irq_register_notify(
        avr_io_getirq(avr_, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT),
        [](avr_irq_t*, uint32_t byte, void* table) {
          auto* t = static_cast<AvrTable*>(table);
          t->sent_.push_back({t->now_us(), static_cast<uint8_t>(byte)});
        },
        this);
  }

  void on_step(int axis) {
    bool is_negative = avr_->data[0x2B] >> DIRECTION_PINS[axis] & 1;
    motor_[axis] += is_negative ? -1 : 1;
    if (axis == 0) {
      if (last_x_step_ != 0) intervals_.push_back(avr_->cycle - last_x_step_);
      last_x_step_ = avr_->cycle;
    }
    set_limit(axis);
  }

  void on_step_end() {
    if (last_x_step_ != 0) longest_pulse_ = std::max(longest_pulse_, avr_->cycle - last_x_step_);
  }

  void set_limit(int axis) {
    bool level = motor_[axis] < switch_at[axis];
    if (limit_level_[axis] == level) return;
    limit_level_[axis] = level;
    avr_raise_irq(avr_io_getirq(avr_, AVR_IOCTL_IOPORT_GETIRQ('B'), LIMIT_PINS[axis]), level);
  }

  uint64_t cycle_now() const { return before_us_ * CYCLES_PER_US + avr_->cycle; }

  void at_cycle(uint64_t cycle, avr_cycle_timer_t call) {
    avr_cycle_timer_cancel(avr_, call, this);
    avr_cycle_timer_register(avr_, cycle > cycle_now() ? cycle - cycle_now() : 1, call, this);
  }

  static avr_cycle_count_t deliver(avr_t* avr, avr_cycle_count_t when, void* table) {
    auto* t = static_cast<AvrTable*>(table);
    if (t->arriving_.empty()) return 0;
    avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT), t->arriving_.front().second);
    t->arriving_.pop_front();
    if (t->arriving_.empty()) return 0;
    uint64_t next = t->arriving_.front().first, now = t->cycle_now();
    return when + (next > now ? next - now : 1);
  }

  void load_memory() {
    std::vector<uint8_t> bytes(MEMORY_BYTES, 0xFF);
    if (!memory_file_.empty()) {
      std::ifstream file(memory_file_, std::ios::binary);
      file.read(reinterpret_cast<char*>(bytes.data()), MEMORY_BYTES);
    }
    avr_eeprom_desc_t memory = {bytes.data(), 0, MEMORY_BYTES};
    avr_ioctl(avr_, AVR_IOCTL_EEPROM_SET, &memory);
  }

  void set_cause(const std::string& cause) {
    avr_->data[MCUSR_AT] = cause == "button" ? 2 : cause == "brown-out" ? 4 : cause == "watchdog" ? 8 : 1;
  }

  struct StepWire {
    AvrTable* table;
    int axis;
  };

  avr_t* avr_;
  std::string memory_file_;
  std::vector<uint8_t> saved_;
  uint64_t before_us_ = 0;  // board time at the last reset
  std::deque<std::pair<uint64_t, uint8_t>> arriving_;
  std::vector<std::pair<uint64_t, uint8_t>> sent_;
  StepWire step_wires_[AXES];
  int64_t motor_[AXES] = {0, 0, 0};
  int limit_level_[AXES] = {-1, -1, -1};
  bool estop_ = false, strobe_ = false, has_ended_ = false;
  long trigger_pulses_ = 0;
  uint64_t last_x_step_ = 0;
  std::vector<uint64_t> intervals_;
  uint64_t longest_pulse_ = 0;
};

}  // namespace

// The simulator talks on stdout, which belongs to the desk; only its errors matter.
void log_errors(avr_t*, const int level, const char* format, va_list values) {
  if (level <= LOG_ERROR) vfprintf(stderr, format, values);
}

int main(int count, char** words) {
  avr_global_logger_set(log_errors);
  std::vector<std::string> options(words + 1, words + count);
  Desk desk(options);
  std::string elf, memory_file;
  long long at[AXES] = {3000, 2000, 1000};
  for (size_t i = 0; i < options.size(); ++i) {
    bool has_value = i + 1 < options.size();
    if (options[i] == "--memory" && has_value) {
      memory_file = options[++i];
    } else if (options[i] == "--switches" && has_value &&
               sscanf(options[i + 1].c_str(), "%lld,%lld,%lld", &at[0], &at[1], &at[2]) == AXES) {
      ++i;
    } else if (elf.empty() && options[i][0] != '-') {
      elf = options[i];
    } else {
      std::cerr << "unknown option: " << options[i] << std::endl;
      return 2;
    }
  }
  if (elf.empty()) {
    std::cerr << "avr_runner ELF --pty | --lockstep [--switches X,Y,Z] [--memory FILE]" << std::endl;
    return 2;
  }
  AvrTable table(elf, memory_file);
  for (int axis = 0; axis < AXES; ++axis) table.switch_at[axis] = at[axis];
  table.set_inputs();
  while (true) {
    uint64_t until_us = desk.next(table.now_us(), table);
    table.run_until(until_us);
    table.take_sent([&](uint8_t byte, uint64_t t_us) { desk.sent(byte, t_us); });
    table.save_memory();
  }
}
