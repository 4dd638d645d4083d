// Counts two wheel encoders and tells the computer, as groundsbot's docs/wheel_protocol.md describes.
// For an Arduino with two quadrature encoders whose A channels are on interrupt pins.
#include <EEPROM.h>

const uint8_t LEFT_A = 2, LEFT_B = 4, RIGHT_A = 3, RIGHT_B = 5;
const uint32_t PERIOD_US = 10000;  // 100 Hz

volatile int32_t ticks_left = 0, ticks_right = 0;
uint32_t boot_id, sequence = 0, next_us;

// Counts both edges of channel A; swap the signs of a wheel that counts backwards.
void on_left()  { ticks_left  += digitalRead(LEFT_A)  == digitalRead(LEFT_B)  ? 1 : -1; }
void on_right() { ticks_right += digitalRead(RIGHT_A) == digitalRead(RIGHT_B) ? -1 : 1; }

uint16_t crc16(const char *data, size_t length) {
  uint16_t crc = 0xFFFF;
  while (length--) {
    crc ^= (uint16_t)(uint8_t)*data++ << 8;
    for (uint8_t bit = 0; bit < 8; bit++) crc = crc & 0x8000 ? (crc << 1) ^ 0x1021 : crc << 1;
  }
  return crc;
}

void setup() {
  EEPROM.get(0, boot_id);
  boot_id++;  // another one at every start
  EEPROM.put(0, boot_id);
  const uint8_t pins[] = {LEFT_A, LEFT_B, RIGHT_A, RIGHT_B};
  for (uint8_t pin : pins) pinMode(pin, INPUT_PULLUP);
  attachInterrupt(digitalPinToInterrupt(LEFT_A), on_left, CHANGE);
  attachInterrupt(digitalPinToInterrupt(RIGHT_A), on_right, CHANGE);
  Serial.begin(115200);
  next_us = micros();
}

void loop() {
  if ((int32_t)(micros() - next_us) < 0) return;
  next_us += PERIOD_US;

  noInterrupts();  // both counts and the time belong to one moment
  const int32_t left = ticks_left, right = ticks_right;
  const uint32_t t_us = micros();
  interrupts();

  char line[96];
  const int length = snprintf(line, sizeof line, "$GBW,1,%lu,%lu,%lu,%ld,%ld,0", (unsigned long)boot_id,
                              (unsigned long)sequence++, (unsigned long)t_us, (long)left, (long)right);
  const uint16_t crc = crc16(line + 1, length - 1);
  snprintf(line + length, sizeof line - length, "*%04X\r\n", crc);
  Serial.print(line);
}
