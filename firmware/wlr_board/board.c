/* Clock, serial line and main loop.
 *
 * Timer 1 counts half microseconds and never stops. The MPU-6050's interrupt pin is on its capture pin (D8), so the hardware
 * stamps each sample: no other work delays the stamp. Every wait has a limit, so the board needs no watchdog, which old Nano
 * bootloaders do not survive. */
#include "board.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <string.h>
#include <util/atomic.h>

#define TICK 2000 /* counts of timer 1: 1 ms */
#define DIVISOR ((F_CPU / 4 / BAUD_RATE + 1) / 2)

#define SPEED (F_CPU / 8 / DIVISOR)

#if SPEED * 1000 > BAUD_RATE * 1025 || SPEED * 1000 < BAUD_RATE * 975
#error "BAUD_RATE: the board's clock makes it only with more than 2.5 % error; expected 57600, 115200, 250000, 500000, 1000000"
#endif
#if IMU_RATE * 24L + 122 * 20L > BAUD_RATE / 10 * 95L / 100
#error "IMU_RATE: its frames and those of the optical flow do not fit into BAUD_RATE; raise BAUD_RATE (500000)"
#endif

status_frame_t board = {
    .sync = {STATUS_SYNC_0, STATUS_SYNC_1},
    .version_major = VERSION_MAJOR,
    .version_minor = VERSION_MINOR,
    .imu_rate = IMU_RATE,
    .gyro_range = GYRO_RANGE,
    .accel_range = ACCEL_RANGE,
    .bandwidth = BANDWIDTH,
    .baud_rate = BAUD_RATE,
};

/* ---- clock ---- */

static volatile uint32_t turns; /* of timer 1, 32768 us each */
static volatile uint8_t ticks;
static volatile bool sample_waits, status_wanted;
static volatile uint32_t sample_moment;
static volatile uint16_t samples, missed;

ISR(TIMER1_OVF_vect) { turns++; }

ISR(TIMER1_COMPA_vect) {
    OCR1A += TICK;
    ticks++;
}

/* Return us at a count of timer 1 that is less than half a turn old; interrupts are off. */
static uint32_t moment_of(uint16_t count) {
    uint32_t whole = turns;
    if ((TIFR1 & _BV(TOV1)) && count < 0x8000) whole++; /* it has turned over, and its interrupt waits */
    return (whole << 15) + (count >> 1);
}

ISR(TIMER1_CAPT_vect) {
    if (sample_waits) missed++;
    sample_moment = moment_of(ICR1);
    samples++;
    sample_waits = true;
}

uint32_t clock_now(void) {
    uint32_t moment;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { moment = moment_of(TCNT1); }
    return moment;
}

/* ---- serial line ---- */

static uint8_t ring[256];
static volatile uint8_t head, tail; /* written there, sent from here; the index wraps with the ring */

ISR(USART_UDRE_vect) {
    UDR0 = ring[tail++];
    if (tail == head) UCSR0B &= ~_BV(UDRIE0);
}

ISR(USART_RX_vect) {
    static uint8_t before;
    uint8_t byte = UDR0;
    if (before == REQUEST_0 && byte == REQUEST_1) status_wanted = true;
    before = byte;
}

static uint16_t crc16(const uint8_t *data, uint8_t size) {
    uint16_t crc = 0;
    while (size--) {
        crc ^= (uint16_t)*data++ << 8;
        for (uint8_t bit = 0; bit < 8; bit++) crc = crc & 0x8000 ? crc << 1 ^ 0x8005 : crc << 1;
    }
    return crc;
}

void send_frame(void *frame, uint8_t size) {
    uint8_t *bytes = frame;
    uint16_t crc = crc16(bytes, size - 2);
    memcpy(bytes + size - 2, &crc, 2);
    if ((uint8_t)(tail - head - 1) < size) {
        board.line_full++;
        return;
    }
    for (uint8_t k = 0; k < size; k++) ring[(uint8_t)(head + k)] = bytes[k];
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        head += size;
        UCSR0B |= _BV(UDRIE0);
    }
}

static void send_status(void) {
    board.sequence++;
    board.microseconds = clock_now();
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { board.imu_missed = missed; }
    send_frame(&board, sizeof board);
}

/* ---- main loop ---- */

void board_begin(void) {
    board.reset_cause = MCUSR; /* a bootloader may have cleared it */
    MCUSR = 0;
    TCCR1A = 0;
    TCCR1B = _BV(ICNC1) | _BV(ICES1) | _BV(CS11); /* rising edges, 2 MHz */
    OCR1A = TCNT1 + TICK;
    TIFR1 = 0xFF;
    TIMSK1 = _BV(ICIE1) | _BV(OCIE1A) | _BV(TOIE1);
    UCSR0A = _BV(U2X0);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UBRR0 = DIVISOR - 1;
    UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);
    set_sleep_mode(SLEEP_MODE_IDLE);
    imu_begin();
    flow_begin();
    sei();
}

void board_step(void) {
    static uint8_t seen;
    if (sample_waits) {
        uint32_t moment;
        uint16_t number;
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
            moment = sample_moment;
            number = samples;
            sample_waits = false;
        }
        imu_sample(number, moment);
    }
    if (seen != ticks) {
        seen = ticks;
        imu_tick();
        flow_tick();
    }
    if (status_wanted) {
        status_wanted = false;
        send_status();
    }
    cli();
    if (!sample_waits && seen == ticks && !status_wanted) {
        sleep_enable();
        sei(); /* the instruction behind it still runs before an interrupt */
        sleep_cpu();
        sleep_disable();
    }
    sei();
}
