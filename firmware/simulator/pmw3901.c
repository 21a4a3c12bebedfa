/* PMW3901 on SPI, NCS on D10. Registers and times: data sheet of the PMW3901MB. */
#include <math.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_spi.h>
#include <string.h>

#include "parts.h"

#define SPCR 0x4C /* of the ATmega328P, address in its memory */
#define SPSR 0x4D
#define T_SRAD 35e-6
#define T_SWX 45e-6 /* from a write to the next transfer */
#define T_SRX 20e-6 /* from a read */
#define T_SCLK_NCS 35e-6 /* from a write's last clock to NCS */

pmw3901_t flow = {.present = true, .floating = 0xFF, .inverse = 0xB6};

static avr_t *chip_of;
static avr_irq_t *line_in;
static uint8_t bank[32][128], current, address, burst[12];
static int position; /* byte of a transfer; -1 = NCS is high */
static bool was_reset;
static uint8_t writes[512];
static size_t written;
static double last_write;
static double next_frame, sum_x, sum_y, address_end, last_end, due;

static void power_on(void) {
    memset(bank, 0, sizeof bank);
    current = 0;
    position = -1;
    was_reset = false;
    sum_x = sum_y = 0;
}

static bool is_tuned(void) {
    return was_reset && bank[0][0x4E] == 0xA8 && bank[0][0x5B] == 0xA0 && bank[0][0x40] == 0x80 && bank[0x15][0x48] == 0x48 &&
           bank[0x0D][0x48] == 0xC0 && bank[7][0x40] == 0x40;
}

static avr_cycle_count_t take(avr_t *avr, avr_cycle_count_t when, void *param) {
    (void)when, (void)param;
    if (flow.present && was_reset) {
        sum_x += is_tuned() ? flow.x : flow.x / 2;
        sum_y += is_tuned() ? flow.y : flow.y / 2;
        flow.frames++;
        if (flow.log) fwrite(&next_frame, sizeof next_frame, 1, flow.log);
    }
    next_frame += 1 / (121.0 * (1 + flow.ppm * 1e-6));
    avr_cycle_count_t next = cycle_at(next_frame);
    return next > avr->cycle ? next : avr->cycle + 1;
}

static int16_t part(double *sum) {
    int16_t whole = (int16_t)trunc(*sum);
    *sum -= whole;
    return whole;
}

static void latch(void) {
    uint16_t x = (uint16_t)part(&sum_x), y = (uint16_t)part(&sum_y), shutter = (uint16_t)((long long)flow.frames & 0x1FFF);
    uint8_t values[12] = {x || y ? 0x80 : 0, 0xBF, x, x >> 8, y, y >> 8, is_tuned() ? 90 : 15, 80, 120, 20, shutter >> 8, shutter};
    memcpy(burst, values, sizeof burst);
}

static uint8_t read_register(void) {
    if (address == 0x16 && current == 0) return position <= 12 ? burst[position - 1] : 0;
    if (current) return bank[current & 31][address];
    switch (address) {
        case 0x00: return 0x49;
        case 0x5F: return (uint8_t)flow.inverse;
        case 0x02: latch(); return burst[0];
        case 0x03: return burst[2];
        case 0x04: return burst[3];
        case 0x05: return burst[4];
        case 0x06: return burst[5];
        case 0x07: return burst[6];
        default: return bank[0][address];
    }
}

static void write_register(uint8_t value) {
    if (written + 2 <= sizeof writes) writes[written++] = address, writes[written++] = value;
    if (written > 2 && now() - last_write > flow.pause) flow.pause = now() - last_write;
    last_write = now();
    if (address == 0x7F) current = value;
    else if (address == 0x3A && current == 0 && value == 0x5A) power_on(), was_reset = true, written = 0, flow.pause = 0;
    else bank[current & 31][address] = value;
}

/* Mode 3, most significant bit first, 2 MHz at most. */
static bool is_clocked_right(void) {
    static const int dividers[] = {4, 16, 64, 128};
    uint8_t control = chip_of->data[SPCR];
    int divider = dividers[control & 3] >> (chip_of->data[SPSR] & 1);
    return (control & 0x2C) == 0x0C && 16.0 / divider <= 2.0;
}

/* A byte has been exchanged; `sent` is the board's. */
static void on_byte(avr_irq_t *irq, uint32_t sent, void *param) {
    (void)irq, (void)param;
    double end = now(), begin = end - 4e-6;
    uint8_t answer = (uint8_t)flow.floating;
    if (flow.present && position >= 0) {
        bool late = position ? address & 0x80 || position > 1 || begin - address_end >= T_SRAD : begin >= due;
        bool good = late && is_clocked_right();
        flow.violations += !good;
        answer = 0;
        if (position == 0) {
            address = sent;
            address_end = end;
            if (address == 0x16) latch();
        } else if (address & 0x80) {
            address &= 0x7F;
            if (good) write_register(sent);
            address |= 0x80;
        } else {
            answer = good ? read_register() : 0x55;
        }
        last_end = end;
        position++;
    }
    avr_raise_irq(line_in, answer);
}

static void on_select(avr_irq_t *irq, uint32_t level, void *param) {
    (void)irq, (void)param;
    if (level && position > 1 && address & 0x80) flow.violations += now() - last_end < T_SCLK_NCS;
    if (level && position > 0) due = last_end + (address & 0x80 ? T_SWX - 8e-6 : address == 0x16 ? 0.5e-6 : T_SRX - 4e-6);
    position = level ? -1 : 0;
}

void flow_print_writes(void) {
    for (size_t k = 0; k < written; k++) printf("%02x", writes[k]);
    printf("\n");
}

void flow_power(bool on) {
    flow.present = on;
    power_on();
}

void flow_attach(avr_t *avr) {
    chip_of = avr;
    power_on();
    line_in = avr_io_getirq(avr, AVR_IOCTL_SPI_GETIRQ(0), SPI_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_SPI_GETIRQ(0), SPI_IRQ_OUTPUT), on_byte, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 2), on_select, NULL);
    avr_cycle_timer_register(avr, 1, take, NULL);
}
