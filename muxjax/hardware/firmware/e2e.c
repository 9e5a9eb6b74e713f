#include "e2e.h"

static uint8_t crc_add(uint8_t crc, uint8_t byte)
{
    crc ^= byte;
    for (int bit = 0; bit < 8; bit++) {
        crc = (uint8_t)((uint8_t)(crc << 1) ^ (crc & 0x80u ? 0x2Fu : 0u));
    }
    return crc;
}

uint8_t e2e_crc8(const uint8_t *data, size_t size)
{
    uint8_t crc = 0xFFu;
    for (size_t k = 0; k < size; k++) {
        crc = crc_add(crc, data[k]);
    }
    return crc ^ 0xFFu;
}

uint8_t e2e_frame_crc(uint16_t id, const uint8_t data[8])
{
    uint8_t crc = crc_add(crc_add(0xFFu, (uint8_t)(id >> 8)), (uint8_t)(id & 0xFFu));
    for (int k = 1; k < 8; k++) {
        crc = crc_add(crc, data[k]);
    }
    return crc ^ 0xFFu;
}

void e2e_protect(uint16_t id, uint8_t data[8], uint8_t counter)
{
    data[1] = (uint8_t)((data[1] & 0xF0u) | (counter & 0x0Fu));
    data[0] = e2e_frame_crc(id, data);
}
