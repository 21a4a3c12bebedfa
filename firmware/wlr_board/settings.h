/* What you may change. `make -C firmware IMU_RATE=500 BAUD_RATE=500000` overrides a line; in the Arduino IDE, edit it.
 * The board reports these numbers, and `wlr doctor` compares them with your hardware file. */
#ifndef SETTINGS_H
#define SETTINGS_H

#ifndef BAUD_RATE
#define BAUD_RATE 115200 /* bit/s; 500000 is exact at 16 MHz, 115200 is 2.1 % fast */
#endif
#ifndef IMU_RATE
#define IMU_RATE 200 /* Hz, 1000 over a whole number: 100, 125, 200, 250, 500 */
#endif
#ifndef GYRO_RANGE
#define GYRO_RANGE 500 /* deg/s: 250, 500, 1000, 2000 */
#endif
#ifndef ACCEL_RANGE
#define ACCEL_RANGE 4 /* g: 2, 4, 8, 16 */
#endif
#ifndef BANDWIDTH
#define BANDWIDTH 44 /* Hz of the chip's filter: 184, 94, 44, 21, 10, 5 */
#endif
#ifndef IMU_ADDRESS
#define IMU_ADDRESS 0x68 /* 0x69 where AD0 is high */
#endif

#if GYRO_RANGE != 250 && GYRO_RANGE != 500 && GYRO_RANGE != 1000 && GYRO_RANGE != 2000
#error "GYRO_RANGE: expected 250, 500, 1000 or 2000 deg/s"
#endif
#if ACCEL_RANGE != 2 && ACCEL_RANGE != 4 && ACCEL_RANGE != 8 && ACCEL_RANGE != 16
#error "ACCEL_RANGE: expected 2, 4, 8 or 16 g"
#endif
#if BANDWIDTH != 184 && BANDWIDTH != 94 && BANDWIDTH != 44 && BANDWIDTH != 21 && BANDWIDTH != 10 && BANDWIDTH != 5
#error "BANDWIDTH: expected 184, 94, 44, 21, 10 or 5 Hz"
#endif
#if IMU_ADDRESS != 0x68 && IMU_ADDRESS != 0x69
#error "IMU_ADDRESS: expected 0x68 or 0x69"
#endif
#if 1000 % IMU_RATE || IMU_RATE > 500 || IMU_RATE < 4
#error "IMU_RATE: expected 1000 over a whole number, 4 to 500 Hz"
#endif

#endif
