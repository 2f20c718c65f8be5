// An Arduino whose chips answer (address, command) with known numbers; the one at 0x10 is silent.
#pragma once
#include <cstdint>
#include <cstdio>

static uint32_t now_us = 0;
static uint32_t micros() { return now_us += 50; }
static void delay(uint32_t ms) { now_us += 1000 * ms; }

static struct {
  void begin(long) {}
  void write(const uint8_t *data, size_t size) { fwrite(data, 1, size, stdout); }
} Serial;

static struct {
  uint8_t address, command, place;
  void begin() {}
  void setClock(long) {}
  void beginTransmission(uint8_t to) { address = to; }
  void write(const uint8_t *data, size_t) { command = data[0], place = 0; }
  int endTransmission() { return address == 0x10 ? 2 : 0; }
  uint8_t requestFrom(uint8_t, uint8_t size) { return size; }
  uint8_t read() {
    const int16_t words[4] = {(int16_t)(46244 + address), (int16_t)(100 * address), (int16_t)(-7 * address), 32767};
    const int i = place++ - 1;
    return i < 0 || command != 0x4F ? 0 : (uint8_t)(i % 2 ? words[i / 2] : words[i / 2] >> 8);
  }
} Wire;
