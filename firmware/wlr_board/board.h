/* Clock, line and counters of the board; what its sensors share. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stdint.h>

#include "frames.h"
#include "settings.h"

#ifdef __cplusplus
extern "C" {
#endif

void board_begin(void); /* once, after reset */
void board_step(void);  /* for ever; sleeps until there is something to do */

uint32_t clock_now(void);                   /* us since boot, wraps at 2^32 */
void send_frame(void *frame, uint8_t size); /* adds the CRC; drops the frame and counts it where the line is full */

/* Settings and counters as the status frame has them. The counters wrap. */
extern status_frame_t board;

/* MPU-6050 */
void imu_begin(void);
void imu_tick(void);                                   /* every millisecond: find the chip, set it up */
void imu_sample(uint16_t sequence, uint32_t moment);   /* the chip has new values since `moment`: read and send them */

/* PMW3901 */
void flow_begin(void);
void flow_tick(void); /* every millisecond: find the chip, set it up, read and send */

#ifdef __cplusplus
}
#endif

#endif
