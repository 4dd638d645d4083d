// What the sketch uses of Adafruit's library: radians a second, from counts at 65.5 a degree per second.
#pragma once
#include <algorithm>
#include "Wire.h"

enum { MPU6050_I2CADDR_DEFAULT = 0x68, MPU6050_RANGE_500_DEG, MPU6050_BAND_94_HZ };
struct sensors_event_t { struct { float x, y, z; } gyro; };
struct Adafruit_Sensor {
  bool getEvent(sensors_event_t *event) {
    const double counts = std::clamp(true_rate_rad_s() / M_PI * 180.0 * 65.5, -32768.0, 32767.0);
    event->gyro.z = (float)((int16_t)counts / 65.5 / 180.0 * M_PI);
    return true;
  }
};
struct Adafruit_MPU6050 {
  Adafruit_Sensor sensor;
  bool begin() { return true; }
  void setGyroRange(int) {}
  void setFilterBandwidth(int) {}
  Adafruit_Sensor *getGyroSensor() { return &sensor; }
};
