/* MPU-6050 on the two-wire bus (A4 SDA, A5 SCL), its interrupt pin on D8. Registers: RM-MPU-6000A, revision 4.2. */
#include <avr/io.h>
#include <string.h>
#include <util/delay.h>

#include "board.h"

enum { DIVIDER = 0x19, CONFIG = 0x1A, GYRO = 0x1B, ACCEL = 0x1C, INT_PIN = 0x37, INT_ENABLE = 0x38 };
enum { VALUES = 0x3B, POWER_1 = 0x6B, WHO_AM_I = 0x75 };

#define IDENTITY 0x68
#define PATIENCE 1000   /* us a byte or a condition may take on the bus */
#define RESET_TIME 100000L /* us */
#define RETRY 100000L   /* us between looks for a chip that is absent */
#define SILENCE (1000000L / IMU_RATE * 5 + 20000) /* us without a sample after which the chip is set up anew */

static enum { ABSENT, RESETTING, RUNNING } state;
static uint32_t since; /* us: of the state, or of the last sample */

static const uint8_t settings[][2] = {
    {POWER_1, 0x01}, /* awake, on the gyroscope's clock */
    {CONFIG, BANDWIDTH == 184 ? 1 : BANDWIDTH == 94 ? 2 : BANDWIDTH == 44 ? 3 : BANDWIDTH == 21 ? 4 : BANDWIDTH == 10 ? 5 : 6},
    {DIVIDER, 1000 / IMU_RATE - 1},
    {GYRO, (GYRO_RANGE == 250 ? 0 : GYRO_RANGE == 500 ? 1 : GYRO_RANGE == 1000 ? 2 : 3) << 3},
    {ACCEL, (ACCEL_RANGE == 2 ? 0 : ACCEL_RANGE == 4 ? 1 : ACCEL_RANGE == 8 ? 2 : 3) << 3},
    {INT_PIN, 0x00}, /* active high, 50 us pulse */
    {INT_ENABLE, 0x01}, /* new values */
};

/* ---- bus ---- */

static void bus_on(void) {
    TWSR = 0;
    TWBR = (F_CPU / 400000L - 16) / 2;
    TWCR = _BV(TWEN);
}

/* A chip that was cut off within a byte holds the data line low: clock it to the byte's end, then stop. */
static void bus_free(void) {
    board.bus_locks++;
    TWCR = 0;
    PORTC &= ~(_BV(4) | _BV(5)); /* driven low as outputs, high by the pull-ups as inputs */
    DDRC &= ~(_BV(4) | _BV(5));
    for (uint8_t pulse = 0; pulse < 10 && !(PINC & _BV(4)); pulse++) {
        DDRC |= _BV(5);
        _delay_us(5);
        DDRC &= ~_BV(5);
        _delay_us(5);
    }
    DDRC |= _BV(4); /* stop: data rises while the clock is high */
    _delay_us(5);
    DDRC &= ~_BV(4);
    _delay_us(5);
    bus_on();
}

/* Start an action of the bus; return its status, 0 where it does not end. */
static uint8_t act(uint8_t action) {
    uint32_t start = clock_now();
    TWCR = action | _BV(TWINT) | _BV(TWEN);
    while (!(TWCR & _BV(TWINT)))
        if (clock_now() - start > PATIENCE) return 0;
    return TWSR & 0xF8;
}

static uint8_t put(uint8_t byte) {
    TWDR = byte;
    return act(0);
}

static bool address(uint8_t reg) { return act(_BV(TWSTA)) == 0x08 && put(IMU_ADDRESS << 1) == 0x18 && put(reg) == 0x28; }

static bool write_one(uint8_t reg, uint8_t value) { return address(reg) && put(value) == 0x28; }

static bool read_all(uint8_t reg, uint8_t *data, uint8_t count) {
    if (!address(reg) || act(_BV(TWSTA)) != 0x10 || put(IMU_ADDRESS << 1 | 1) != 0x40) return false;
    while (count--) {
        if (act(count ? _BV(TWEA) : 0) != (count ? 0x50 : 0x58)) return false;
        *data++ = TWDR;
    }
    return true;
}

/* End a transfer; return whether it was good. */
static bool ended(bool good) {
    uint8_t status = TWSR & 0xF8;
    bool locked = !(TWCR & _BV(TWINT)); /* still at it: the data or the clock line is held */
    uint32_t start = clock_now();
    TWCR = _BV(TWINT) | _BV(TWSTO) | _BV(TWEN);
    while (TWCR & _BV(TWSTO) && !locked) locked = clock_now() - start > PATIENCE;
    if (!good) board.bus_errors++;
    if (locked || (!good && (status == 0x00 || status == 0x38))) bus_free();
    return good;
}

static bool write_register(uint8_t reg, uint8_t value) { return ended(write_one(reg, value)); }
static bool read_registers(uint8_t reg, uint8_t *data, uint8_t count) { return ended(read_all(reg, data, count)); }

/* ---- chip ---- */

static bool set_up(void) {
    uint8_t found;
    for (uint8_t k = 0; k < sizeof settings / 2; k++) {
        if (!write_register(settings[k][0], settings[k][1])) return false;
        if (!read_registers(settings[k][0], &found, 1) || found != settings[k][1]) return false;
    }
    return true;
}

static void become(uint8_t next) {
    state = next;
    since = clock_now();
    if (next == RUNNING) board.sensors |= SENSOR_IMU;
    else board.sensors &= ~SENSOR_IMU;
}

void imu_begin(void) {
    bus_on();
    since = clock_now() - RETRY;
}

void imu_tick(void) {
    uint32_t elapsed = clock_now() - since;
    if (state == ABSENT && elapsed >= RETRY) {
        uint16_t errors = board.bus_errors;
        board.imu_identity = 0;
        bool found = read_registers(WHO_AM_I, &board.imu_identity, 1) && board.imu_identity == IDENTITY;
        if (!board.imu_identity) board.bus_errors = errors; /* nobody is there: no fault of the bus */
        become(found && write_register(POWER_1, 0x80) ? RESETTING : ABSENT);
    } else if (state == RESETTING && elapsed >= RESET_TIME) {
        become(set_up() ? RUNNING : ABSENT);
    } else if (state == RUNNING && elapsed >= SILENCE) {
        board.imu_restarts++;
        become(ABSENT);
        since -= RETRY; /* look at once */
    }
}

void imu_sample(uint16_t sequence, uint32_t moment) {
    static imu_frame_t frame = {.sync = {IMU_SYNC_0, IMU_SYNC_1}};
    uint8_t raw[14];
    if (state != RUNNING || !read_registers(VALUES, raw, sizeof raw)) return; /* the sequence number tells */
    since = clock_now();
    frame.sequence = sequence;
    frame.microseconds = moment;
    int16_t *value = &frame.accel_x;
    for (uint8_t k = 0; k < 7; k++) value[k] = (int16_t)(raw[2 * k] << 8 | raw[2 * k + 1]); /* the chip sends high bytes first */
    send_frame(&frame, sizeof frame);
}
