/* Frames of i2t's `crc` format (i2t/hardware/reskin/layouts.py), for any little-endian processor:

   A5 5A, a counter (uint8), chips x float32 (t in degrees Celsius, x, y, z in uT), CRC-32 of all bytes after A5 5A. */
#pragma once
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define FRAME_BYTES(chips) (2 + 1 + 16 * (chips) + 4)

static uint32_t frame_crc32(const uint8_t *data, size_t size) {
  uint32_t crc = 0xFFFFFFFFu;
  while (size--) {
    crc ^= *data++;
    for (int bit = 0; bit < 8; bit++) crc = (crc >> 1) ^ ((crc & 1u) ? 0xEDB88320u : 0u);
  }
  return ~crc;
}

/* Values of a chip from its answer: t, x, y, z as 16 bits each, at GAIN_SEL 7, RES 0 and HALLCONF C. */
static void frame_values(const uint8_t answer[8], float values[4]) {
  const float step[4] = {1.0f / 45.2f, 0.150f, 0.150f, 0.242f};
  for (int i = 0; i < 4; i++) {
    const uint16_t word = (uint16_t)(answer[2 * i] << 8 | answer[2 * i + 1]);
    values[i] = step[i] * (i ? (float)(int16_t)word : (float)word - 46244.0f);
  }
  values[0] += 25.0f;
}

/* Packs chips x (t, x, y, z) into FRAME_BYTES(chips) bytes; x = y = z = 0 for a chip that did not answer. */
static void frame_pack(uint8_t *frame, uint8_t count, const float *values, size_t chips) {
  frame[0] = 0xA5;
  frame[1] = 0x5A;
  frame[2] = count;
  memcpy(frame + 3, values, 16 * chips);
  const uint32_t crc = frame_crc32(frame + 2, 1 + 16 * chips);
  memcpy(frame + 3 + 16 * chips, &crc, 4);
}
