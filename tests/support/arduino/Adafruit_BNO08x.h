// What the sketch uses of Adafruit's library: an event each period of the sensor's own clock, 1/512 radians a second.
#pragma once
#include <algorithm>
#include "Wire.h"

enum { SH2_GYROSCOPE_CALIBRATED = 2 };
struct sh2_SensorValue_t {
  int sensorId;
  struct { struct { float x, y, z; } gyroscope; } un;
};
struct Adafruit_BNO08x {
  uint32_t period_us = 0, next_us = 0;
  bool begin_I2C() { return true; }
  bool wasReset() { return false; }
  bool enableReport(int, uint32_t interval_us) {
    period_us = interval_us * 101 / 100;
    next_us = micros() + period_us;
    return true;
  }
  bool getSensorEvent(sh2_SensorValue_t *value) {
    if ((int32_t)(micros() - next_us) < 0) return false;
    next_us += period_us;
    if (!gyro_answers()) return false;
    value->sensorId = SH2_GYROSCOPE_CALIBRATED;
    value->un.gyroscope.z = (float)(round(std::clamp(true_rate_rad_s(), -34.91, 34.91) * 512.0) / 512.0);
    return true;
  }
};
