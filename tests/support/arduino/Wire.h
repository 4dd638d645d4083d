#pragma once
#include "Arduino.h"
struct TwoWire {
  void begin() {}
  void setClock(uint32_t) {}
  void beginTransmission(uint8_t) {}
  uint8_t endTransmission() { return gyro_answers() ? 0 : 2; }
};
inline TwoWire Wire;
