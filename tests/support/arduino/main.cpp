// Runs the sketch for as many seconds as the first argument says; what it sends goes to the standard output.
#include <cstdlib>
#include "Arduino.h"

uint32_t now_us = 4294000000u;  // it wraps around after a second
int levels[8] = {0};
Port Serial;
static double since_s = 0.0;
static void (*counted[8])() = {nullptr};

void attachInterrupt(int pin, void (*act)(), int) { counted[pin] = act; }

// A sine of 2 rad/s, with 60 rad/s from 3 s to 3.1 s.
double true_rate_rad_s() { return since_s > 3.0 && since_s < 3.1 ? 60.0 : 2.0 * sin(since_s); }
bool gyro_answers() { return since_s < 5.0 || since_s > 5.2; }

#include SKETCH

int main(int, char **arguments) {
  const int passes = atoi(arguments[1]) * 10000;
  Serial.seen_us = now_us;
  setup();
  for (int pass = 0; pass < passes; pass++) {
    if (pass % 20 == 0) {  // left forward, right backward, an edge each 2 ms
      for (int pin = 2; pin <= 3; pin++) {
        levels[pin] ^= 1;
        levels[pin + 2] = levels[pin];
        counted[pin]();
      }
    }
    loop();
    now_us += 100;
    since_s = (pass + 1) * 1e-4;
  }
}
