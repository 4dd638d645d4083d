// What the sketch uses of SparkFun's library: counts of 16 bits at 65.5 a degree per second.
#pragma once
#include <algorithm>
#include "Wire.h"

enum ICM_20948_Status_e { ICM_20948_Stat_Ok, ICM_20948_Stat_Err };
enum { ICM_20948_Internal_Acc = 1, ICM_20948_Internal_Gyr = 2 };
enum { gpm2, dps500, acc_d50bw4_n68bw8, gyr_d51bw2_n73bw3 };
struct ICM_20948_fss_t { uint8_t a, g; };
struct ICM_20948_dlpcfg_t { uint8_t a, g; };
struct ICM_20948_I2C {
  ICM_20948_Status_e status;
  struct { struct { struct { int16_t x, y, z; } axes; } gyr; } agmt;
  void begin(TwoWire &, bool) {}
  void setFullScale(uint8_t, ICM_20948_fss_t) {}
  void setDLPFcfg(uint8_t, ICM_20948_dlpcfg_t) {}
  void enableDLPF(uint8_t, bool) {}
  void getAGMT() {
    status = gyro_answers() ? ICM_20948_Stat_Ok : ICM_20948_Stat_Err;
    agmt.gyr.axes.z = (int16_t)std::clamp(true_rate_rad_s() / M_PI * 180.0 * 65.5, -32768.0, 32767.0);
  }
};
