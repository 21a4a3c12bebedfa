/* MPU-6050 on the two-wire interface, INT on D8. Register map: RM-MPU-6000A, revision 4.2. */
#include <math.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_twi.h>
#include <string.h>

#include "parts.h"

#define ADDRESS 0x68

mpu6050_t imu = {.present = true, .accel = {0, 0, 9.80665}};

static avr_t *chip_of;
static avr_irq_t *bus_in, *pin_sda, *pin_int;
static uint8_t reg[128], pointer;
static bool selected, has_pointer;
static double reset_over, next_sample;
static int clocks;

uint8_t imu_register(int at) { return reg[at & 127]; }

bool imu_holds_bus(void) { return imu.hold || imu.hang_clocks; }

static void power_on(void) {
    memset(reg, 0, sizeof reg);
    reg[0x6B] = 0x40; /* asleep */
    reg[0x75] = ADDRESS;
}

static void put(int at, double value) {
    int16_t count = (int16_t)lrint(fmin(fmax(value, -32768), 32767));
    reg[at] = (uint8_t)((uint16_t)count >> 8);
    reg[at + 1] = (uint8_t)count;
}

static double period(void) {
    int filter = reg[0x1A] & 7;
    double rate = (filter == 0 || filter == 7 ? 8000.0 : 1000.0) / (1 + reg[0x19]);
    return 1 / (rate * (1 + imu.ppm * 1e-6));
}

static avr_cycle_count_t pin_down(avr_t *avr, avr_cycle_count_t when, void *param) {
    (void)avr, (void)when, (void)param;
    avr_raise_irq(pin_int, 0);
    return 0;
}

static avr_cycle_count_t sample(avr_t *avr, avr_cycle_count_t when, void *param) {
    (void)when, (void)param;
    double moment = next_sample;
    next_sample += period();
    if (imu.present && !(reg[0x6B] & 0x40)) {
        double per_g = 32768.0 / (2 << (reg[0x1C] >> 3 & 3)), per_dps = 32768.0 / (250 << (reg[0x1B] >> 3 & 3));
        for (int k = 0; k < 3; k++) {
            put(0x3B + 2 * k, imu.accel[k] / 9.80665 * per_g);
            put(0x43 + 2 * k, imu.gyro[k] * per_dps);
        }
        put(0x41, (double)((long long)imu.samples & 0x7FFF));
        imu.samples++;
        if (imu.log) fwrite(&moment, sizeof moment, 1, imu.log);
        reg[0x3A] |= 1;
        if (reg[0x38] & 1 && !(reg[0x37] & 0x80)) {
            avr_raise_irq(pin_int, 1);
            avr_cycle_timer_register(avr, 50e-6 * avr->frequency, pin_down, NULL);
        }
    }
    avr_cycle_count_t next = cycle_at(next_sample);
    return next > avr->cycle ? next : avr->cycle + 1;
}

static void write_register(uint8_t at, uint8_t value) {
    if (now() < reset_over || at >= sizeof reg || at == 0x75 || (at >= 0x3A && at <= 0x60)) return;
    if (at == 0x6B && value & 0x80) {
        power_on();
        reset_over = now() + 0.03;
        return;
    }
    reg[at] = value;
}

static uint8_t read_register(void) {
    uint8_t value = pointer < sizeof reg ? reg[pointer] : 0;
    if (pointer == 0x3A) reg[0x3A] = 0;
    pointer++;
    return value;
}

static void on_bus(avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq, (void)param;
    avr_twi_msg_irq_t message = {.u.v = value};
    uint8_t what = message.u.twi.msg;
    if (!imu.present || imu_holds_bus()) return;
    if (what & TWI_COND_STOP) selected = false;
    if (what & TWI_COND_START) {
        selected = message.u.twi.addr >> 1 == ADDRESS;
        has_pointer = message.u.twi.addr & 1;
        if (selected) avr_raise_irq(bus_in, avr_twi_irq_msg(TWI_COND_ACK, message.u.twi.addr, 1));
    } else if (selected && what & TWI_COND_WRITE) {
        avr_raise_irq(bus_in, avr_twi_irq_msg(TWI_COND_ACK, message.u.twi.addr, 1));
        if (has_pointer) write_register(pointer++, message.u.twi.data);
        else pointer = message.u.twi.data;
        has_pointer = true;
    } else if (selected && what & TWI_COND_READ) {
        avr_raise_irq(bus_in, avr_twi_irq_msg(TWI_COND_READ, message.u.twi.addr, read_register()));
    }
}

/* Somebody drives the clock by hand: DDRC bit 5 going back to an input is a rising edge. */
static void on_direction(avr_irq_t *irq, uint32_t value, void *param) {
    (void)param;
    bool rises = irq->value & 0x20 && !(value & 0x20);
    if (irq->value & 0x10 && !(value & 0x10) && !(value & 0x20)) imu.stops++; /* data rises while the clock is high */
    if (imu.hang_clocks && rises && ++clocks >= imu.hang_clocks) imu.hang_clocks = clocks = 0;
    avr_ioport_external_t pulls = {.name = 'C', .mask = 0x30, .value = imu.hang_clocks ? 0x20 : 0x30};
    avr_ioctl(chip_of, AVR_IOCTL_IOPORT_SET_EXTERNAL('C'), &pulls);
    avr_raise_irq(pin_sda, !imu.hang_clocks);
}

void imu_power(bool on) {
    imu.present = on;
    selected = false;
    power_on();
}

void imu_attach(avr_t *avr) {
    chip_of = avr;
    power_on();
    bus_in = avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_INPUT);
    pin_sda = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('C'), 4);
    pin_int = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 0);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_OUTPUT), on_bus, NULL);
    avr_irq_t *direction = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('C'), IOPORT_IRQ_DIRECTION_ALL);
    avr_irq_register_notify(direction, on_direction, NULL);
    avr_cycle_timer_register(avr, 1, sample, NULL);
}
