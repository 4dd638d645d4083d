#pragma once
#include <cstdint>
struct {
  uint32_t value = 41;
  void get(int, uint32_t &into) { into = value; }
  void put(int, uint32_t from) { value = from; }
} EEPROM;
