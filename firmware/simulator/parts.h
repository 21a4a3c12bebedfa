/* Simulated sensors, from their data sheets' register maps; they share nothing with the firmware. */
#ifndef PARTS_H
#define PARTS_H

#include <simavr/sim_avr.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>

/* True time, s, and back: the board's crystal is off, and its cycles are no clock. */
double now(void);
avr_cycle_count_t cycle_at(double moment);

typedef struct {
    bool present;
    double accel[3], gyro[3]; /* m/s2, deg/s, the chip's axes */
    double ppm;               /* error of the chip's own clock */
    double samples;           /* taken since power-on, never reset; the temperature register holds the number's low 15 bits */
    double hang_clocks;       /* the data line stays low until so many clocks came; 0 = free */
    double hold;              /* 1 = somebody holds the clock line */
    double stops;             /* conditions that the board made by hand */
    FILE *log;                /* true time of each sample, s, as doubles; NULL = none */
} mpu6050_t;

typedef struct {
    bool present;
    double x, y;       /* motion, counts per frame of the chip */
    double ppm;        /* error of the chip's own clock */
    double floating;   /* what an absent chip's line reads: 0xFF or 0 */
    double frames;     /* taken; the shutter register holds the number's low 13 bits */
    double violations; /* of the data sheet's times and clock */
    double inverse;    /* what register 0x5F reads */
    double pause;      /* longest time between two writes after the reset, s */
    FILE *log;
} pmw3901_t;

extern mpu6050_t imu;
extern pmw3901_t flow;

void imu_attach(avr_t *avr);
void imu_power(bool on);
bool imu_holds_bus(void);
uint8_t imu_register(int at);
void flow_attach(avr_t *avr);
void flow_power(bool on);
void flow_print_writes(void); /* register and value of each since the reset, as hexadecimal digits */

#endif
