/* PMW3901 on SPI, mode 3, 2 MHz (D11 MOSI, D12 MISO, D13 SCK, D10 NCS). Registers and times: data sheet of the PMW3901MB.
 *
 * The chip takes 121 frames a second and does not say when. Polled every millisecond, it reports motion once per frame, which
 * tells the moment. A frame without motion says nothing: after a period and a quarter it counts as taken when it was due. */
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <util/delay.h>

#include "board.h"

enum { PRODUCT = 0x00, MOTION = 0x02, BURST = 0x16, POWER_UP = 0x3A, INVERSE = 0x5F };

#define IDENTITY 0x49
#define PERIOD 8264     /* us: 121 Hz */
#define RETRY 100000L   /* us between looks at the chip's identity */
#define RESET_TIME 5000 /* us */
#define PAUSE 0xFF      /* no register: wait so many ms */

/* The data sheet's list "performance optimization registers": register, value. */
static const uint8_t PROGMEM tuning[] = {
    0x7F, 0x00, 0x61, 0xAD, 0x7F, 0x03, 0x40, 0x00, 0x7F, 0x05, 0x41, 0xB3, 0x43, 0xF1, 0x45, 0x14, 0x5B, 0x32, 0x5F, 0x34,
    0x7B, 0x08, 0x7F, 0x06, 0x44, 0x1B, 0x40, 0xBF, 0x4E, 0x3F, 0x7F, 0x08, 0x65, 0x20, 0x6A, 0x18, 0x7F, 0x09, 0x4F, 0xAF,
    0x5F, 0x40, 0x48, 0x80, 0x49, 0x80, 0x57, 0x77, 0x60, 0x78, 0x61, 0x78, 0x62, 0x08, 0x63, 0x50, 0x7F, 0x0A, 0x45, 0x60,
    0x7F, 0x00, 0x4D, 0x11, 0x55, 0x80, 0x74, 0x1F, 0x75, 0x1F, 0x4A, 0x78, 0x4B, 0x78, 0x44, 0x08, 0x45, 0x50, 0x64, 0xFF,
    0x65, 0x1F, 0x7F, 0x14, 0x65, 0x67, 0x66, 0x08, 0x63, 0x70, 0x7F, 0x15, 0x48, 0x48, 0x7F, 0x07, 0x41, 0x0D, 0x43, 0x14,
    0x4B, 0x0E, 0x45, 0x0F, 0x44, 0x42, 0x4C, 0x80, 0x7F, 0x10, 0x5B, 0x02, 0x7F, 0x07, 0x40, 0x41, 0x70, 0x00, PAUSE, 10,
    0x32, 0x44, 0x7F, 0x07, 0x40, 0x40, 0x7F, 0x06, 0x62, 0xF0, 0x63, 0x00, 0x7F, 0x0D, 0x48, 0xC0, 0x6F, 0xD5, 0x7F, 0x00,
    0x5B, 0xA0, 0x4E, 0xA8, 0x5A, 0x50, 0x40, 0x80,
};

static enum { ABSENT, RESETTING, TUNING, RUNNING } state;
static uint32_t since, checked; /* us: of the state, or of the chip's last frame; of the last look at its identity */
static uint8_t next, pause;     /* item of the list; ms until then */

static uint8_t transfer(uint8_t byte) {
    SPDR = byte;
    while (!(SPSR & _BV(SPIF))) /* the chip has no say in when it ends */
        ;
    return SPDR;
}

static void select(void) { PORTB &= ~_BV(2); }

static void release(void) {
    _delay_us(1);
    PORTB |= _BV(2);
}

static void read_registers(uint8_t reg, uint8_t *data, uint8_t count) {
    select();
    transfer(reg);
    _delay_us(35); /* t_SRAD */
    while (count--) *data++ = transfer(0);
    release();
}

static uint8_t read_register(uint8_t reg) {
    uint8_t value;
    read_registers(reg, &value, 1);
    _delay_us(20); /* t_SRR */
    return value;
}

static void write_register(uint8_t reg, uint8_t value) {
    select();
    transfer(reg | 0x80);
    transfer(value);
    _delay_us(35); /* t_SCLK-NCS */
    release();
}

static bool is_there(void) {
    checked = clock_now();
    return read_register(PRODUCT) == IDENTITY && read_register(INVERSE) == (uint8_t)~IDENTITY;
}

static void become(uint8_t then) {
    state = then;
    since = clock_now();
    if (then == RUNNING) board.sensors |= SENSOR_FLOW;
    else board.sensors &= ~SENSOR_FLOW;
}

static void lose(void) {
    board.flow_restarts++;
    become(ABSENT);
}

void flow_begin(void) {
    PORTB |= _BV(2);
    DDRB |= _BV(2) | _BV(3) | _BV(5);
    SPCR = _BV(SPE) | _BV(MSTR) | _BV(CPOL) | _BV(CPHA) | _BV(SPR0);
    SPSR = _BV(SPI2X);
    checked = clock_now() - RETRY;
}

static void tune(void) {
    if (pause && pause--) return;
    if (next == sizeof tuning) {
        for (uint8_t reg = MOTION; reg < MOTION + 5; reg++) read_register(reg); /* what it counted until now */
        become(RUNNING);
        return;
    }
    uint8_t reg = pgm_read_byte(tuning + next++), value = pgm_read_byte(tuning + next++);
    if (reg == PAUSE) pause = value;
    else write_register(reg, value);
}

static void measure(void) {
    static flow_frame_t frame = {.sync = {FLOW_SYNC_0, FLOW_SYNC_1}};
    uint8_t raw[12]; /* motion, observation, x, y (low bytes first), SQUAL, sum, greatest, least pixel, shutter (high first) */
    uint32_t now = clock_now();
    read_registers(BURST, raw, sizeof raw);
    if (raw[10] & 0xE0) { /* a shutter has 13 bits: nobody drives the line */
        lose();
        return;
    }
    uint16_t interval = now - since;
    if (!(raw[0] & 0x80)) {
        if (interval < PERIOD + PERIOD / 4) return;
        interval = PERIOD;
    }
    since += interval;
    frame.sequence++;
    frame.microseconds = since;
    frame.interval = interval;
    frame.x = (int16_t)(raw[3] << 8 | raw[2]);
    frame.y = (int16_t)(raw[5] << 8 | raw[4]);
    frame.quality = raw[6];
    frame.shutter = raw[10] << 8 | raw[11];
    send_frame(&frame, sizeof frame);
}

void flow_tick(void) {
    uint32_t now = clock_now();
    if (state == ABSENT) {
        if (now - checked < RETRY || !is_there()) return;
        write_register(POWER_UP, 0x5A);
        next = pause = 0;
        become(RESETTING);
    } else if (state == RESETTING) {
        if (now - since >= RESET_TIME) become(TUNING);
    } else if (now - checked >= RETRY && state == RUNNING && !is_there()) {
        lose();
    } else if (state == TUNING) {
        tune();
    } else {
        measure();
    }
}
