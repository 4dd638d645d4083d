// As much of Arduino as the sketch in docs/robot uses, on a clock of the test's own.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstdio>

enum { INPUT_PULLUP, CHANGE };
extern uint32_t now_us;
extern int levels[8];

inline uint32_t micros() { return now_us; }
inline void pinMode(uint8_t, int) {}
inline int digitalRead(uint8_t pin) { return levels[pin]; }
inline int digitalPinToInterrupt(uint8_t pin) { return pin; }
inline void noInterrupts() {}
inline void interrupts() {}
void attachInterrupt(int pin, void (*act)(), int mode);

// A port with a buffer of 63 bytes, as AVRs have, that is emptied at its baud rate.
struct Port {
  double room = 63.0, bytes_per_us = 0.0;
  uint32_t seen_us = 0;
  void begin(uint32_t baud) { bytes_per_us = baud / 10e6; }
  int availableForWrite() {
    room = fmin(63.0, room + (now_us - seen_us) * bytes_per_us);
    seen_us = now_us;
    return (int)room;
  }
  void write(char byte) {
    room -= 1.0;
    putchar(byte);
  }
};
extern Port Serial;

// What the gyro is turned by, whether it answers, and what it is called: of the test.
double true_rate_rad_s();
bool gyro_answers();
