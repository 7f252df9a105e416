#include "settings.h"

#include <stddef.h>

#include "crc.h"
#include "serial.h"

namespace uvgs {
namespace settings {

Settings now;

namespace {

enum Kind : uint8_t { BYTE, SWITCH, WORD, REAL };

struct Entry {
  uint8_t number, kind, offset;
  float lowest, highest, preset;
};

constexpr float HUGE_VALUE = 1e6f;
// The step interrupt takes up to 42 us with three axes: at this rate half the processor is left for everything else.
constexpr float FASTEST_STEPS_PER_S = 12000.0f;

#define AT(field) static_cast<uint8_t>(offsetof(Settings, field))
#define AXIS_ENTRIES(base, field, lowest, highest, preset)                      \
  {base, REAL, AT(field), lowest, highest, preset},                             \
      {base + 1, REAL, AT(field) + sizeof(float), lowest, highest, preset},     \
      {base + 2, REAL, AT(field) + 2 * sizeof(float), lowest, highest, preset}

const Entry TABLE[] UVGS_FLASH = {
    {0, BYTE, AT(pulse_us), 3, 20, 10},
    {1, BYTE, AT(motor_idle_ms), 0, 255, 25},
    {2, BYTE, AT(step_invert), 0, ALL_AXES, 0},
    {3, BYTE, AT(direction_invert), 0, ALL_AXES, 0},
    {4, SWITCH, AT(enable_invert), 0, HUGE_VALUE, 0},
    {5, SWITCH, AT(limit_invert), 0, HUGE_VALUE, 0},
    {6, SWITCH, AT(probe_invert), 0, HUGE_VALUE, 0},
    {10, BYTE, AT(report_mask), 0, 3, 1},
    {11, REAL, AT(junction_mm), 0, HUGE_VALUE, 0.010f},
    {12, REAL, AT(arc_mm), 0, HUGE_VALUE, 0.002f},
    {13, SWITCH, AT(inches), 0, 0, 0},
    {20, SWITCH, AT(soft_limits), 0, HUGE_VALUE, 0},
    {21, SWITCH, AT(hard_limits), 0, HUGE_VALUE, 0},
    {22, SWITCH, AT(homing), 0, HUGE_VALUE, 0},
    {23, BYTE, AT(homing_negative), 0, ALL_AXES, 0},
    {24, REAL, AT(locate_mm_min), 0.1f, HUGE_VALUE, 25},
    {25, REAL, AT(seek_mm_min), 0.1f, HUGE_VALUE, 500},
    {26, WORD, AT(debounce_ms), 0, 60000, 250},
    {27, REAL, AT(pull_off_mm), 0.001f, HUGE_VALUE, 1},
    {30, WORD, AT(rpm_max), 1, 60000, 1000},
    {31, WORD, AT(rpm_min), 0, 60000, 0},
    {32, SWITCH, AT(laser), 0, 0, 0},
    AXIS_ENTRIES(100, steps_per_mm, 0.01f, HUGE_VALUE, 250),
    AXIS_ENTRIES(110, max_mm_min, 0.1f, HUGE_VALUE, 500),
    AXIS_ENTRIES(120, max_mm_s2, 0.1f, HUGE_VALUE, 10),
    AXIS_ENTRIES(130, travel_mm, 0, HUGE_VALUE, 200),
    {200, SWITCH, AT(push_done), 0, HUGE_VALUE, 0},
    {201, SWITCH, AT(need_homing), 0, HUGE_VALUE, 1},
    {202, WORD, AT(heartbeat_ms), 0, 60000, 0},
    {203, BYTE, AT(estop), 0, 2, 0},
    {204, WORD, AT(trigger_us), 8, 65000, 200},
    {205, WORD, AT(settle_ms), 0, 60000, 100},
    {206, BYTE, AT(strobe_edge), 0, 2, 0},
    AXIS_ENTRIES(210, approach_mm, -1000, 1000, 0),
};
constexpr uint8_t COUNT = sizeof(TABLE) / sizeof(TABLE[0]);

Entry entry(uint8_t index) {
  Entry copy;
  const uint8_t* from = reinterpret_cast<const uint8_t*>(&TABLE[index]);
  for (uint8_t i = 0; i < sizeof(Entry); ++i) reinterpret_cast<uint8_t*>(&copy)[i] = hal::flash_byte(from + i);
  return copy;
}

uint8_t* place(const Entry& e) { return reinterpret_cast<uint8_t*>(&now) + e.offset; }

void put(const Entry& e, float value) {
  switch (e.kind) {
    case BYTE: *place(e) = static_cast<uint8_t>(value); break;
    case SWITCH: *place(e) = value != 0.0f; break;
    case WORD: *reinterpret_cast<uint16_t*>(place(e)) = static_cast<uint16_t>(value); break;
    default: *reinterpret_cast<float*>(place(e)) = value;
  }
}

float get(const Entry& e) {
  switch (e.kind) {
    case BYTE:
    case SWITCH: return *place(e);
    case WORD: return *reinterpret_cast<uint16_t*>(place(e));
    default: return *reinterpret_cast<float*>(place(e));
  }
}

// --- memory: boot number at 0 and 4 (value, complement), settings at 16 and 272 (layout, turn, CRC, struct) ---

constexpr uint8_t LAYOUT = 1;
constexpr uint16_t FIRST_COPY = 16, SECOND_COPY = 272;
constexpr uint8_t HEADER = 4;
constexpr uint16_t COPY_BYTES = HEADER + sizeof(Settings);
static_assert(COPY_BYTES <= 256, "two copies must fit");

uint8_t header[HEADER];
uint8_t boot_bytes[4];
uint16_t boot;
uint8_t turn;
// 0 nothing; boot number and settings are written one after the other.
volatile uint8_t writing;
constexpr uint8_t WRITE_BOOT = 1, WRITE_SETTINGS = 2;
volatile uint16_t write_index;

uint16_t word_at(uint16_t address) {
  return static_cast<uint16_t>(hal::eeprom_read(address) | hal::eeprom_read(address + 1) << 8);
}

// Start writing the copy whose turn it is; the other stays whole until this one is.
void store() {
  uint16_t sum = crc16(crc16(CRC16_START, LAYOUT), turn);
  for (uint8_t i = 0; i < sizeof(Settings); ++i) sum = crc16(sum, reinterpret_cast<uint8_t*>(&now)[i]);
  hal::Quiet quiet;
  header[0] = LAYOUT;
  header[1] = turn;
  header[2] = static_cast<uint8_t>(sum);
  header[3] = static_cast<uint8_t>(sum >> 8);
  if (!(writing & WRITE_BOOT)) write_index = 0;
  writing = writing | WRITE_SETTINGS;
}

bool read_copy(uint16_t address) {
  uint16_t sum = CRC16_START;
  sum = crc16(crc16(sum, hal::eeprom_read(address)), hal::eeprom_read(address + 1));
  for (uint8_t i = 0; i < sizeof(Settings); ++i) sum = crc16(sum, hal::eeprom_read(address + HEADER + i));
  if (hal::eeprom_read(address) != LAYOUT || sum != word_at(address + 2)) return false;
  for (uint8_t i = 0; i < sizeof(Settings); ++i)
    reinterpret_cast<uint8_t*>(&now)[i] = hal::eeprom_read(address + HEADER + i);
  turn = hal::eeprom_read(address + 1);
  return true;
}

void count_boot() {
  boot = 0;
  for (uint8_t slot = 0; slot < 2; ++slot) {
    uint16_t value = word_at(slot * 4);
    if (value == static_cast<uint16_t>(~word_at(slot * 4 + 2)) && value > boot) boot = value;
  }
  ++boot;
  boot_bytes[0] = static_cast<uint8_t>(boot);
  boot_bytes[1] = static_cast<uint8_t>(boot >> 8);
  boot_bytes[2] = static_cast<uint8_t>(~boot);
  boot_bytes[3] = static_cast<uint8_t>(~boot >> 8);
  hal::Quiet quiet;
  write_index = 0;
  writing = WRITE_BOOT;
}

}  // namespace

bool load() {
  count_boot();
  bool has_first = read_copy(FIRST_COPY);
  uint8_t first_turn = turn;
  // The second is read over the first; when it is the older one the first is read again.
  bool has_second = read_copy(SECOND_COPY);
  if (has_first && has_second && static_cast<int8_t>(turn - first_turn) < 0) read_copy(FIRST_COPY);
  bool is_whole = has_first || has_second;
  if (!is_whole) {
    for (uint8_t i = 0; i < COUNT; ++i) put(entry(i), entry(i).preset);
    turn = 0;
    store();
  }
  ++turn;
  hal::start_writing();
  return is_whole;
}

uint16_t boot_number() { return boot; }

uint8_t set(uint16_t number, float value) {
  for (uint8_t i = 0; i < COUNT; ++i) {
    Entry e = entry(i);
    if (e.number != number) continue;
    if (value < 0.0f && e.lowest >= 0.0f) return 4;
    if (number == 0 && value < e.lowest) return 6;
    if (number == 32 && value != 0.0f) return 17;
    if (!(value >= e.lowest && value <= e.highest)) return 52;
    if (number == 20 && value != 0.0f && !now.homing) return 10;
    float before = get(e);
    {
      hal::Quiet quiet;
      put(e, value);
    }
    for (uint8_t axis = 0; axis < AXES; ++axis) {
      if (now.max_mm_min[axis] * now.steps_per_mm[axis] <= FASTEST_STEPS_PER_S * 60.0f) continue;
      put(e, before);
      return 12;
    }
    if (number == 22 && value == 0.0f) now.soft_limits = 0;
    store();
    hal::start_writing();
    return 0;
  }
  return 3;
}

void restore_defaults() {
  for (uint8_t i = 0; i < COUNT; ++i) put(entry(i), entry(i).preset);
  store();
  hal::start_writing();
}

void print_all(bool extended) {
  for (uint8_t i = 0; i < COUNT; ++i) {
    Entry e = entry(i);
    if ((e.number >= 200) != extended) continue;
    serial::put('$');
    serial::unsigned_number(e.number);
    serial::put('=');
    if (e.kind == REAL) {
      serial::fixed3(get(e));
    } else {
      serial::unsigned_number(static_cast<uint32_t>(get(e)));
    }
    serial::end_line();
  }
}

bool is_writing() { return writing != 0; }

Write next_to_write(uint16_t& address, uint8_t& value) {
  // Few at a time, since the step interrupt waits for this one.
  for (uint8_t tries = 0; tries < 8; ++tries) {
    if (writing == 0) return Write::done;
    uint16_t index = write_index;
    write_index = index + 1;
    if (writing & WRITE_BOOT) {
      if (index < sizeof(boot_bytes)) {
        address = static_cast<uint16_t>((boot & 1) * 4 + index);
        value = boot_bytes[index];
        return Write::byte;
      }
      write_index = 0;
      writing = writing & static_cast<uint8_t>(~WRITE_BOOT);
      continue;
    }
    if (index == COPY_BYTES) {
      writing = 0;
      // The next change goes to the other copy.
      turn = static_cast<uint8_t>(header[1] + 1);
      continue;
    }
    address = static_cast<uint16_t>((header[1] & 1 ? SECOND_COPY : FIRST_COPY) + index);
    value = index < HEADER ? header[index] : reinterpret_cast<uint8_t*>(&now)[index - HEADER];
    if (hal::eeprom_read(address) != value) return Write::byte;
  }
  return Write::again;
}

}  // namespace settings
}  // namespace uvgs
