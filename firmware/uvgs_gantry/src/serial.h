// The serial line: two rings, real-time bytes picked off in the interrupt, and printing.
#pragma once
#include "hal.h"

namespace uvgs {
namespace serial {

constexpr uint8_t RX_BYTES = 128;

void init();
void on_received(uint8_t byte);       // interrupt
bool next_to_send(uint8_t& byte);     // interrupt; false when there is nothing
bool has_received();
int16_t read();                       // -1 when there is nothing
uint8_t rx_free();
uint16_t rx_lost();                   // bytes dropped because the ring was full
uint32_t last_byte_ticks();           // when the host was last heard
void forget_received();

void put(char character);
void text(const char* in_flash);      // use with UVGS_TEXT("...")
void end_line();
void number(int32_t value);
void unsigned_number(uint32_t value);
void hex(uint16_t value, uint8_t digits);
void fixed3(float value);             // three decimals
void microseconds(Instant instant);

// Between these, what is printed is also summed into a CRC-16; the end prints "*CRC]" and ends the line.
void begin_checked(const char* name_in_flash);  // prints "[NAME:"
void end_checked();

}  // namespace serial
}  // namespace uvgs
