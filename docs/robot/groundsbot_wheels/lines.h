// Lines of the protocol: made in one buffer, sent as the port has room, so that no reading waits for a line before it.
uint32_t boot_id;

char line[256];
uint16_t line_bytes;
char waiting[384];
uint16_t first_waiting = 0, n_waiting = 0;

uint16_t crc16(const char *data, size_t length) {
  uint16_t crc = 0xFFFF;
  while (length--) {
    crc ^= (uint16_t)(uint8_t)*data++ << 8;
    for (uint8_t bit = 0; bit < 8; bit++) crc = crc & 0x8000 ? (crc << 1) ^ 0x1021 : crc << 1;
  }
  return crc;
}

// The part that all lines have: name and version, boot, sequence, time.
void begin_line(const char *name, uint32_t sequence, uint32_t t_us) {
  line_bytes = snprintf(line, sizeof line, "$%s,%lu,%lu,%lu", name, (unsigned long)boot_id, (unsigned long)sequence,
                        (unsigned long)t_us);
}

void add_field(int32_t number) {
  line_bytes += snprintf(line + line_bytes, sizeof line - line_bytes, ",%ld", (long)number);
}

void add_letter(char letter) {
  line_bytes += snprintf(line + line_bytes, sizeof line - line_bytes, ",%c", letter);
}

// Queues the line; one that has no room is left out, which its sequence number shows.
void end_line() {
  line_bytes += snprintf(line + line_bytes, sizeof line - line_bytes, "*%04X\r\n", crc16(line + 1, line_bytes - 1));
  if (line_bytes > sizeof waiting - n_waiting) return;
  for (uint16_t at = 0; at < line_bytes; at++) waiting[(first_waiting + n_waiting++) % sizeof waiting] = line[at];
}

void send_waiting() {
  for (int room = Serial.availableForWrite(); room > 0 && n_waiting; room--, n_waiting--) {
    Serial.write(waiting[first_waiting]);
    first_waiting = (first_waiting + 1) % sizeof waiting;
  }
}

// Whether `next_us` has come; moves it on by whole periods, so that what was missed is not made up for in a burst.
bool is_due(uint32_t &next_us, uint32_t period_us) {
  const uint32_t late_us = micros() - next_us;
  if ((int32_t)late_us < 0) return false;
  next_us += period_us * (1 + late_us / period_us);
  return true;
}
