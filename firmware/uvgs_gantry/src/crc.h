// Checksums. crc16 is CRC-16/CCITT-FALSE ("123456789" gives 0x29B1), crc8 has polynomial 0x07 ("123456789" gives 0xF4).
#pragma once
#include <stdint.h>

namespace uvgs {

constexpr uint16_t CRC16_START = 0xFFFF;

inline uint16_t crc16(uint16_t crc, uint8_t byte) {
  crc ^= static_cast<uint16_t>(byte) << 8;
  for (uint8_t bit = 0; bit < 8; ++bit)
    crc = static_cast<uint16_t>(crc & 0x8000 ? (crc << 1) ^ 0x1021 : crc << 1);
  return crc;
}

inline uint8_t crc8(uint8_t crc, uint8_t byte) {
  crc ^= byte;
  for (uint8_t bit = 0; bit < 8; ++bit) crc = static_cast<uint8_t>(crc & 0x80 ? (crc << 1) ^ 0x07 : crc << 1);
  return crc;
}

}  // namespace uvgs
