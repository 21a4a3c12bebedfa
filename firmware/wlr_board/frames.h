/* Written by firmware/header.py from wlr_gym/hardware/serial_frames.py: change it there. */
#ifndef FRAMES_H
#define FRAMES_H

#include <stdint.h>

#define VERSION_MAJOR 0x01
#define VERSION_MINOR 0x00
#define REQUEST_0 0xa5
#define REQUEST_1 0x3f
#define SENSOR_IMU 0x01
#define SENSOR_FLOW 0x02

#define IMU_SYNC_0 0xa5
#define IMU_SYNC_1 0x5a
typedef struct __attribute__((packed)) {
    uint8_t sync[2];
    uint16_t sequence;
    uint32_t microseconds;
    int16_t accel_x;
    int16_t accel_y;
    int16_t accel_z;
    int16_t temperature;
    int16_t gyro_x;
    int16_t gyro_y;
    int16_t gyro_z;
    uint16_t crc;
} imu_frame_t;

#define FLOW_SYNC_0 0xa5
#define FLOW_SYNC_1 0xf1
typedef struct __attribute__((packed)) {
    uint8_t sync[2];
    uint16_t sequence;
    uint32_t microseconds;
    uint16_t interval;
    int16_t x;
    int16_t y;
    uint8_t quality;
    uint8_t zero;
    uint16_t shutter;
    uint16_t crc;
} flow_frame_t;

#define STATUS_SYNC_0 0xa5
#define STATUS_SYNC_1 0xc3
typedef struct __attribute__((packed)) {
    uint8_t sync[2];
    uint16_t sequence;
    uint32_t microseconds;
    uint8_t version_major;
    uint8_t version_minor;
    uint8_t reset_cause;
    uint8_t sensors;
    uint16_t imu_rate;
    uint16_t gyro_range;
    uint8_t accel_range;
    uint8_t bandwidth;
    uint32_t baud_rate;
    uint8_t imu_identity;
    uint16_t bus_errors;
    uint16_t bus_locks;
    uint16_t imu_restarts;
    uint16_t imu_missed;
    uint16_t flow_restarts;
    uint16_t line_full;
    uint16_t crc;
} status_frame_t;

#endif
