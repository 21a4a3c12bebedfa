/* An ATmega328P that runs the firmware's very binary, with simulated sensors and its serial line on a pseudo-terminal.
 *
 * simulator FIRMWARE.elf [SAMPLES FRAMES]   (files for the true moments of the sensors' samples and frames)
 *
 * It prints the terminal's path, then obeys lines on standard input, and answers each with one:
 *   run SECONDS        let true time pass; answers the true time, s
 *   set NAME VALUE     a name of the table below
 *   get NAME
 *   reset CAUSE        of the chip, with MCUSR = CAUSE; 4 (brown-out) takes the sensors' power, too
 *   poke ADDRESS VALUE four bytes of the chip's memory
 *   peek ADDRESS       one byte of it
 *   register ADDRESS   of the MPU-6050
 *   writes             to the PMW3901 since its reset: registers and values */
#define _GNU_SOURCE
#include <fcntl.h>
#include <simavr/avr_twi.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_time.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <termios.h>
#include <unistd.h>

#include "parts.h"

#define SPCR 0x4C /* of the ATmega328P, addresses in its memory */
#define SPSR 0x4D
#define MCUSR 0x54
#define TCCR1B 0x81
#define TWBR 0xB8
#define TWCR 0xBC
#define UBRR 0xC4
#define FREQUENCY 16000000.0

static avr_t *avr;
static int terminal, far_side;
static double board_ppm, since;                      /* true time at `base` */
static avr_cycle_count_t base;
static double sent, hit, drop, flip, garbled;        /* bytes; probabilities that the line loses or changes one */
static double imu_present = 1, flow_present = 1;
static double clock_start; /* true time at which timer 1 first counts at 2 MHz, s */
static uint8_t line[1 << 20];
static size_t waiting;
static unsigned reader; /* bit/s that the reader has set */

double now(void) { return since + (double)(avr->cycle - base) / (FREQUENCY * (1 + board_ppm * 1e-6)); }

avr_cycle_count_t cycle_at(double moment) {
    double cycles = (moment - since) * FREQUENCY * (1 + board_ppm * 1e-6);
    return cycles > 0 ? base + (avr_cycle_count_t)cycles : base;
}

static const struct {
    const char *name;
    double *value;
} table[] = {
    {"accel_x", imu.accel}, {"accel_y", imu.accel + 1}, {"accel_z", imu.accel + 2}, {"gyro_x", imu.gyro},
    {"gyro_y", imu.gyro + 1}, {"gyro_z", imu.gyro + 2}, {"imu_ppm", &imu.ppm}, {"samples", &imu.samples},
    {"hang_clocks", &imu.hang_clocks}, {"hold", &imu.hold}, {"imu", &imu_present}, {"flow", &flow_present},
    {"flow_x", &flow.x}, {"flow_y", &flow.y}, {"flow_ppm", &flow.ppm}, {"floating", &flow.floating},
    {"frames", &flow.frames}, {"violations", &flow.violations}, {"board_ppm", &board_ppm}, {"sent", &sent}, {"hit", &hit},
    {"drop", &drop}, {"flip", &flip}, {"garbled", &garbled}, {"stops", &imu.stops}, {"inverse", &flow.inverse},
    {"pause", &flow.pause}, {"clock_start", &clock_start},
};

static double *find(const char *name) {
    for (size_t k = 0; k < sizeof table / sizeof *table; k++)
        if (!strcmp(table[k].name, name)) return table[k].value;
    return NULL;
}

/* ---- the library's buses, mended ---- */

/* The library takes a microsecond for a bit of the two-wire bus, where TWBR says how long; a held bus never ends. It answers to
 * an address for writing with the status of a data byte, and in no time, and the flag that an action has ended stays up where
 * it was down before. A byte of SPI takes it 100 us (1.6). */
void avr_cycle_timer_register_usec(avr_t *chip, uint32_t usec, avr_cycle_timer_t timer, void *param) {
    const char *kind = ((avr_io_t *)param)->kind;
    avr_cycle_count_t cycles = avr_usec_to_cycles(chip, usec);
    if (!strcmp(kind, "twi")) {
        avr_twi_t *bus = param;
        chip->data[TWCR] &= 0x7F;
        if (imu_holds_bus()) return;
        if (!usec && (bus->next_twstate == 0x28 || bus->next_twstate == 0x30)) bus->next_twstate -= 0x10, usec = 9;
        cycles = (usec ? usec : 1) * (16 + 2 * chip->data[TWBR]);
    } else if (!strcmp(kind, "spi")) {
        static const int dividers[] = {4, 16, 64, 128};
        cycles = 8 * dividers[chip->data[SPCR] & 3] >> (chip->data[SPSR] & 1);
    }
    avr_cycle_timer_register(chip, cycles, timer, param);
}

/* ---- serial line ---- */

static unsigned reader_speed(void) {
    unsigned char settings[44] = {0}; /* struct termios2 */
    unsigned speed = 0;
    if (ioctl(far_side, 0x802C542A, settings) == 0) memcpy(&speed, settings + 40, 4);
    return speed;
}

static void on_sent(avr_irq_t *irq, uint32_t byte, void *param) {
    (void)irq, (void)param;
    static uint8_t control = 0;
    double speed = FREQUENCY * (1 + board_ppm * 1e-6) / 8 / (1 + avr->data[UBRR] + 256 * avr->data[UBRR + 1]);
    sent++;
    if (reader && (speed / reader > 1.03 || speed / reader < 0.97)) byte ^= 0x5A + control++, garbled++;
    if (drand48() < drop) {
        hit++;
        return;
    }
    if (drand48() < flip) byte ^= 1 << lrand48() % 8, hit++;
    if (waiting < sizeof line) line[waiting++] = byte;
}

static void exchange(void) {
    uint8_t bytes[32];
    reader = reader_speed();
    ssize_t count = read(terminal, bytes, sizeof bytes);
    avr_irq_t *in = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    for (ssize_t k = 0; k < count; k++) avr_raise_irq(in, bytes[k]);
    ssize_t done = write(terminal, line, waiting);
    if (done > 0) memmove(line, line + done, waiting -= done);
}

static const char *open_terminal(void) {
    terminal = posix_openpt(O_RDWR | O_NOCTTY);
    grantpt(terminal);
    unlockpt(terminal);
    far_side = open(ptsname(terminal), O_RDWR | O_NOCTTY);
    struct termios settings;
    tcgetattr(far_side, &settings);
    cfmakeraw(&settings);
    tcsetattr(far_side, TCSANOW, &settings);
    fcntl(terminal, F_SETFL, O_NONBLOCK);
    return ptsname(terminal);
}

/* ---- chip ---- */

static void do_not_sleep(avr_t *chip, avr_cycle_count_t cycles) { (void)chip, (void)cycles; }

static void attach(void) {
    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_sent, NULL);
    imu_attach(avr);
    flow_attach(avr);
}

static bool run(double seconds) {
    avr_cycle_count_t end = cycle_at(now() + seconds);
    exchange();
    while (avr->cycle < end) {
        int state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed) return false;
        if (!clock_start && (avr->data[TCCR1B] & 7) == 2) clock_start = now();
    }
    exchange();
    return true;
}

static void reset(int cause) {
    since = now();
    avr_reset(avr);
    base = avr->cycle;
    avr->data[MCUSR] = cause;
    if (cause == 4) imu_power(imu.present), flow_power(flow.present);
    attach();
}

static void set(const char *name, double value) {
    double *place = find(name);
    since = now(), base = avr->cycle; /* a new rate of the crystal counts from here */
    *place = value;
    if (place == &imu_present) imu_power(value);
    if (place == &flow_present) flow_power(value);
}

int main(int count, char **words) {
    elf_firmware_t firmware = {0};
    setvbuf(stdout, NULL, _IOLBF, 0);
    if (count < 2 || elf_read_firmware(words[1], &firmware)) return 1;
    avr = avr_make_mcu_by_name("atmega328p");
    avr_init(avr);
    avr->frequency = firmware.frequency = (uint32_t)FREQUENCY;
    avr_load_firmware(avr, &firmware);
    avr->sleep = do_not_sleep;
    avr->log = LOG_NONE;
    if (count > 3) imu.log = fopen(words[2], "wb"), flow.log = fopen(words[3], "wb");
    attach();
    printf("%s\n", open_terminal());
    char input[200], what[20], name[40];
    while (fgets(input, sizeof input, stdin)) {
        double value = 0;
        *name = 0;
        if (sscanf(input, "%19s %39s %lf", what, name, &value) < 1) continue;
        if (!strcmp(what, "run")) {
            if (!run(atof(name))) return 2;
            if (imu.log) fflush(imu.log), fflush(flow.log);
            printf("%.9f\n", now());
        } else if (!strcmp(what, "reset")) {
            reset(atoi(name));
            printf("%.9f\n", now());
        } else if (!strcmp(what, "poke")) {
            uint32_t number = (uint32_t)value;
            memcpy(avr->data + strtol(name, NULL, 0), &number, 4);
            printf("ok\n");
        } else if (!strcmp(what, "peek")) {
            printf("%d\n", avr->data[strtol(name, NULL, 0)]);
        } else if (!strcmp(what, "register")) {
            printf("%d\n", imu_register((int)strtol(name, NULL, 0)));
        } else if (!strcmp(what, "writes")) {
            flow_print_writes();
        } else if (find(name)) {
            if (!strcmp(what, "set")) set(name, value);
            printf("%.9f\n", *find(name));
        } else {
            printf("unknown: %s", input);
        }
    }
    return 0;
}
