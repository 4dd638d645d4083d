// The gyro: yaw rates in batches, in the common part, and one section for each kind of gyro.
#include <Wire.h>

enum Reading : uint8_t { NOTHING_NEW, MEASURED, SATURATED, UNREADABLE };

const uint8_t BATCH = 100000 / GYRO_PERIOD_US > 19 ? 20 : 100000 / GYRO_PERIOD_US > 1 ? 100000 / GYRO_PERIOD_US : 1;

int32_t rates_urad_s[BATCH];
uint8_t readings[BATCH], n_samples = 0;
uint32_t gyro_sequence = 0, next_gyro_us, first_us, last_us;

void begin_sensor();
Reading read_sensor(float &rad_s);

void begin_gyro() {
  Wire.begin();
  Wire.setClock(400000);
  begin_sensor();
  next_gyro_us = micros();
}

bool answers(uint8_t address) {
  Wire.beginTransmission(address);
  return Wire.endTransmission() == 0;
}

void send_samples() {
  begin_line("GBG,2", gyro_sequence, first_us);
  add_field(n_samples > 1 ? (last_us - first_us) / (n_samples - 1) : GYRO_PERIOD_US);  // as measured
  for (uint8_t at = 0; at < n_samples; at++) {
    if (readings[at] == MEASURED) add_field(GYRO_SIGN * rates_urad_s[at]);
    else add_letter(readings[at] == SATURATED ? 'S' : 'E');
  }
  end_line();
  gyro_sequence += n_samples;
  n_samples = 0;
}

void read_gyro() {
  float rad_s = 0.0;
  const uint32_t t_us = micros();
  const Reading reading = read_sensor(rad_s);
  if (reading == NOTHING_NEW) return;
  const bool is_late = t_us - last_us > GYRO_PERIOD_US * 3 / 2, is_long = t_us - first_us > 99000;
  if (n_samples && (is_late || is_long)) send_samples();  // a batch is evenly spaced, and 0.1 s long at most
  if (n_samples == 0) first_us = t_us;
  last_us = t_us;
  readings[n_samples] = reading;
  rates_urad_s[n_samples++] = lround(rad_s * 1e6);
  if (n_samples == BATCH) send_samples();
}

#if GYRO == GYRO_ICM20948
#include <ICM_20948.h>

const uint8_t ADDRESS = 0x69;                            // 0x68 where AD0 is low
const float RAD_S_PER_COUNT = 3.14159265 / 180.0 / 65.5;  // at 500 degrees a second
ICM_20948_I2C icm;

void begin_sensor() {
  icm.begin(Wire, ADDRESS & 1);
  ICM_20948_fss_t range = {};
  range.a = gpm2;
  range.g = dps500;
  icm.setFullScale(ICM_20948_Internal_Acc | ICM_20948_Internal_Gyr, range);
  ICM_20948_dlpcfg_t filter = {};
  filter.a = acc_d50bw4_n68bw8;
  filter.g = gyr_d51bw2_n73bw3;  // below half the rate of samples
  icm.setDLPFcfg(ICM_20948_Internal_Acc | ICM_20948_Internal_Gyr, filter);
  icm.enableDLPF(ICM_20948_Internal_Gyr, true);
}

Reading read_sensor(float &rad_s) {
  if (!is_due(next_gyro_us, GYRO_PERIOD_US)) return NOTHING_NEW;
  icm.getAGMT();
  if (icm.status != ICM_20948_Stat_Ok) return UNREADABLE;
  const int16_t count = icm.agmt.gyr.axes.z;
  rad_s = count * RAD_S_PER_COUNT;
  return count == 32767 || count == -32768 ? SATURATED : MEASURED;
}
#endif

#if GYRO == GYRO_BNO085
#include <Adafruit_BNO08x.h>

const float RANGE_RAD_S = 34.9;  // 2000 degrees a second
Adafruit_BNO08x bno;
uint32_t newest_us;

void begin_sensor() {
  bno.begin_I2C();
  bno.enableReport(SH2_GYROSCOPE_CALIBRATED, GYRO_PERIOD_US);
  newest_us = micros();
}

Reading read_sensor(float &rad_s) {
  if (bno.wasReset()) bno.enableReport(SH2_GYROSCOPE_CALIBRATED, GYRO_PERIOD_US);
  sh2_SensorValue_t value;
  if (bno.getSensorEvent(&value) && value.sensorId == SH2_GYROSCOPE_CALIBRATED) {
    newest_us = micros();
    rad_s = value.un.gyroscope.z;
    return fabs(rad_s) >= RANGE_RAD_S ? SATURATED : MEASURED;
  }
  if (micros() - newest_us < 5 * GYRO_PERIOD_US) return NOTHING_NEW;  // its clock is its own
  newest_us = micros();
  return UNREADABLE;
}
#endif

#if GYRO == GYRO_MPU6050
#include <Adafruit_MPU6050.h>

const float RANGE_RAD_S = 499.9 / 180.0 * 3.14159265;  // the library's scale ends at 500.27 degrees a second
Adafruit_MPU6050 mpu;

void begin_sensor() {
  mpu.begin();
  mpu.setGyroRange(MPU6050_RANGE_500_DEG);
  mpu.setFilterBandwidth(MPU6050_BAND_94_HZ);  // below half the rate of samples
}

Reading read_sensor(float &rad_s) {
  if (!is_due(next_gyro_us, GYRO_PERIOD_US)) return NOTHING_NEW;
  if (!answers(MPU6050_I2CADDR_DEFAULT)) return UNREADABLE;
  sensors_event_t event;
  mpu.getGyroSensor()->getEvent(&event);
  rad_s = event.gyro.z;
  return fabs(rad_s) >= RANGE_RAD_S ? SATURATED : MEASURED;
}
#endif
