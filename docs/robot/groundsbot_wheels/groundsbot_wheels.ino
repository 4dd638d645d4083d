// Counts two wheel encoders, reads a gyro if there is one, and tells the computer, as groundsbot's docs/wheel_protocol.md
// describes. For an Arduino with two quadrature encoders whose A channels are on interrupt pins.
#include <EEPROM.h>

#define GYRO_NONE 0
#define GYRO_ICM20948 1  // library "SparkFun 9DoF IMU Breakout - ICM 20948"
#define GYRO_BNO085 2    // library "Adafruit BNO08x"; needs more memory than an Uno has
#define GYRO_MPU6050 3   // library "Adafruit MPU6050"
#ifndef GYRO
#define GYRO GYRO_NONE  // which of them is wired to SDA and SCL
#endif

const uint8_t LEFT_A = 2, LEFT_B = 4, RIGHT_A = 3, RIGHT_B = 5;
const uint32_t BAUD = 115200;
const uint32_t WHEEL_PERIOD_US = 10000;  // 100 Hz
const uint32_t GYRO_PERIOD_US = 5000;    // 200 Hz
const int8_t GYRO_SIGN = 1;              // -1 where the gyro's z axis points down

#include "lines.h"
#if GYRO != GYRO_NONE
#include "gyro.h"
#endif

volatile int32_t ticks_left = 0, ticks_right = 0;
uint32_t wheel_sequence = 0, next_wheels_us;

// Counts both edges of channel A; swap the signs of a wheel that counts backwards.
void on_left()  { ticks_left  += digitalRead(LEFT_A)  == digitalRead(LEFT_B)  ? 1 : -1; }
void on_right() { ticks_right += digitalRead(RIGHT_A) == digitalRead(RIGHT_B) ? -1 : 1; }

void setup() {
  EEPROM.get(0, boot_id);
  boot_id++;  // another one at every start
  EEPROM.put(0, boot_id);
  const uint8_t pins[] = {LEFT_A, LEFT_B, RIGHT_A, RIGHT_B};
  for (uint8_t pin : pins) pinMode(pin, INPUT_PULLUP);
  attachInterrupt(digitalPinToInterrupt(LEFT_A), on_left, CHANGE);
  attachInterrupt(digitalPinToInterrupt(RIGHT_A), on_right, CHANGE);
  Serial.begin(BAUD);
#if GYRO != GYRO_NONE
  begin_gyro();
#endif
  next_wheels_us = micros();
}

void send_wheels() {
  noInterrupts();  // both counts and the time belong to one moment
  const int32_t left = ticks_left, right = ticks_right;
  const uint32_t t_us = micros();
  interrupts();
  begin_line("GBW,1", wheel_sequence++, t_us);
  add_field(left);
  add_field(right);
  add_field(0);
  end_line();
}

void loop() {
  if (is_due(next_wheels_us, WHEEL_PERIOD_US)) send_wheels();
#if GYRO != GYRO_NONE
  read_gyro();
#endif
  send_waiting();
}
