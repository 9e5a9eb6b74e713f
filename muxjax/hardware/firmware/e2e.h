/* Byte 0 (CRC-8) and the alive counter of every frame; docs/protocol.md, "Frames". */
#ifndef E2E_H
#define E2E_H

#include <stddef.h>
#include <stdint.h>

/* CRC-8 of AUTOSAR's E2E profile 2: polynomial 0x2F, start 0xFF, final xor 0xFF. */
uint8_t e2e_crc8(const uint8_t *data, size_t size);

/* CRC of a frame: over its id (two bytes, high one first), then bytes 1 to 7. */
uint8_t e2e_frame_crc(uint16_t id, const uint8_t data[8]);

/* Write a packed frame's counter and, over the rest, its CRC. */
void e2e_protect(uint16_t id, uint8_t data[8], uint8_t counter);

#endif
