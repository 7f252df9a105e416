#include "serial.h"

#include "crc.h"
#include "machine.h"
#include "stepper.h"

namespace uvgs {
namespace serial {
namespace {

constexpr uint8_t TX_BYTES = 48;
uint8_t rx[RX_BYTES], tx[TX_BYTES];
// The receive indices run freely and their difference is the number of bytes held; the others wrap, one slot is free.
volatile uint8_t rx_in, rx_out, tx_in, tx_out;
volatile uint16_t lost;
volatile uint32_t heard_ticks;
uint16_t sum;
bool is_summing;

uint8_t after_tx(uint8_t index) { return index + 1 == TX_BYTES ? 0 : static_cast<uint8_t>(index + 1); }

}  // namespace

void init() {
  hal::Quiet quiet;
  rx_in = rx_out = tx_in = tx_out = 0;
  lost = 0;
  heard_ticks = 0;
  is_summing = false;
}

void on_received(uint8_t byte) {
  heard_ticks = hal::ticks();
  if (machine::on_real_time_byte(byte) || byte > 0x7F) return;
  if (static_cast<uint8_t>(rx_in - rx_out) == RX_BYTES) {
    lost = lost + 1;
    return;
  }
  rx[rx_in & (RX_BYTES - 1)] = byte;
  rx_in = static_cast<uint8_t>(rx_in + 1);
}

bool next_to_send(uint8_t& byte) {
  if (tx_in == tx_out) return false;
  byte = tx[tx_out];
  tx_out = after_tx(tx_out);
  return true;
}

bool has_received() { return rx_in != rx_out; }

int16_t read() {
  if (rx_in == rx_out) return -1;
  uint8_t byte = rx[rx_out & (RX_BYTES - 1)];
  rx_out = static_cast<uint8_t>(rx_out + 1);
  return byte;
}

uint8_t rx_free() { return static_cast<uint8_t>(RX_BYTES - static_cast<uint8_t>(rx_in - rx_out)); }

uint16_t rx_lost() {
  hal::Quiet quiet;
  return lost;
}

uint32_t last_byte_ticks() {
  hal::Quiet quiet;
  return heard_ticks;
}

void forget_received() {
  hal::Quiet quiet;
  rx_out = rx_in;
}

void put(char character) {
  uint8_t byte = static_cast<uint8_t>(character);
  if (is_summing) sum = crc16(sum, byte);
  while (after_tx(tx_in) == tx_out) {
    stepper::prepare();
    hal::watchdog_feed();
    hal::idle(false);
  }
  {
    hal::Quiet quiet;
    tx[tx_in] = byte;
    tx_in = after_tx(tx_in);
  }
  hal::start_sending();
}

void text(const char* in_flash) {
  for (char c; (c = static_cast<char>(hal::flash_byte(in_flash))) != '\0'; ++in_flash) put(c);
}

void end_line() {
  put('\r');
  put('\n');
}

void unsigned_number(uint32_t value) {
  char digits[10];
  uint8_t count = 0;
  do {
    digits[count++] = static_cast<char>('0' + value % 10);
    value /= 10;
  } while (value != 0);
  while (count > 0) put(digits[--count]);
}

void number(int32_t value) {
  if (value < 0) put('-');
  unsigned_number(value < 0 ? 0u - static_cast<uint32_t>(value) : static_cast<uint32_t>(value));
}

void hex(uint16_t value, uint8_t digits) {
  while (digits-- > 0) {
    uint8_t nibble = (value >> (4 * digits)) & 0x0F;
    put(static_cast<char>(nibble < 10 ? '0' + nibble : 'A' + nibble - 10));
  }
}

namespace {

void padded(uint32_t value, uint32_t unit) {
  for (; unit > 1 && value < unit; unit /= 10) put('0');
  if (unit > 0) unsigned_number(value);
}

}  // namespace

void fixed3(float value) {
  int32_t thousandths = static_cast<int32_t>(value * 1000.0f + (value < 0.0f ? -0.5f : 0.5f));
  if (thousandths < 0) {
    put('-');
    thousandths = -thousandths;
  }
  uint32_t whole = static_cast<uint32_t>(thousandths) / 1000;
  unsigned_number(whole);
  put('.');
  padded(static_cast<uint32_t>(thousandths) - whole * 1000, 100);
}

void microseconds(Instant instant) {
  // One unit of the high part is 32768 us exactly.
  uint64_t us = static_cast<uint64_t>(instant.high) * 32768u + (instant.low >> 1);
  uint32_t million = static_cast<uint32_t>(us / 1000000u);
  uint32_t rest = static_cast<uint32_t>(us - static_cast<uint64_t>(million) * 1000000u);
  if (million > 0) {
    unsigned_number(million);
    padded(rest, 100000);
  } else {
    unsigned_number(rest);
  }
}

void begin_checked(const char* name_in_flash) {
  put('[');
  sum = CRC16_START;
  is_summing = true;
  text(name_in_flash);
  put(':');
}

void end_checked() {
  is_summing = false;
  put('*');
  hex(sum, 4);
  put(']');
  end_line();
}

}  // namespace serial
}  // namespace uvgs
