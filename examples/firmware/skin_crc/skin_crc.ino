// Reads MLX90393 chips on one I2C bus and sends frames of i2t's `crc` format at 400 Hz.
//
// Adapt to your board: ADDRESSES, one for each chip, in the order of its board file; `choose`, where chips with one
// address are behind a multiplexer; and for more than about seven chips the bus's clock, or PERIOD_US, as a chip takes
// 0.3 ms at 400 kHz. Any little-endian Arduino works (SAMD21, RP2040, ESP32). Tested with emulated chips only.
#include <Wire.h>

#include "frame.h"

static const uint8_t ADDRESSES[] = {0x0C, 0x13, 0x12, 0x10, 0x11};  // the order of ReSkin's board
static const size_t CHIPS = sizeof ADDRESSES;
static const uint32_t PERIOD_US = 2500;

static const uint8_t EXIT[] = {0x80}, RESET[] = {0xF0};
static const uint8_t GAIN[] = {0x60, 0x00, 0x7C, 0x00 << 2};  // register 0: GAIN_SEL 7, HALLCONF C
static const uint8_t QUICK[] = {0x60, 0x00, 0x00, 0x02 << 2};  // register 2: RES, DIG_FILT and OSR 0
static const uint8_t BURST[] = {0x1F}, READ[] = {0x4F};        // t, x, y, z
static const uint8_t FAILED = 0x10;                            // bit of the status

static void choose(size_t chip) {
  (void)chip;  // for a TCA9548A: Wire.beginTransmission(0x70); Wire.write(1 << channel_of[chip]); Wire.endTransmission();
}

// Sends a command; the answer begins with a status. False if the chip does not answer or reports a failure.
static bool ask(size_t chip, const uint8_t *command, size_t length, uint8_t *answer, size_t size) {
  Wire.beginTransmission(ADDRESSES[chip]);
  Wire.write(command, length);
  if (Wire.endTransmission() != 0 || Wire.requestFrom(ADDRESSES[chip], (uint8_t)size) != size) return false;
  for (size_t i = 0; i < size; i++) answer[i] = Wire.read();
  return !(answer[0] & FAILED);
}

void setup() {
  Serial.begin(921600);  // ignored over USB
  Wire.begin();
  Wire.setClock(400000);
  uint8_t status;
  for (size_t chip = 0; chip < CHIPS; chip++) {
    choose(chip);
    ask(chip, EXIT, sizeof EXIT, &status, 1);
    delay(2);
    ask(chip, RESET, sizeof RESET, &status, 1);
    delay(2);
    ask(chip, GAIN, sizeof GAIN, &status, 1);
    ask(chip, QUICK, sizeof QUICK, &status, 1);
    ask(chip, BURST, sizeof BURST, &status, 1);
  }
}

void loop() {
  static uint32_t due = micros();
  static uint8_t count = 0;
  float values[4 * CHIPS] = {0};
  uint8_t answer[9], frame[FRAME_BYTES(CHIPS)];
  for (size_t chip = 0; chip < CHIPS; chip++) {
    choose(chip);
    if (ask(chip, READ, sizeof READ, answer, sizeof answer)) frame_values(answer + 1, values + 4 * chip);
  }
  frame_pack(frame, count++, values, CHIPS);
  Serial.write(frame, sizeof frame);
  due += PERIOD_US;
  if ((int32_t)(micros() - due) > 0) due = micros();  // late: skip missed frames
  while ((int32_t)(micros() - due) < 0) {
  }
}
