/* Without the Arduino core. */
#include "wlr_board/board.h"

int main(void) {
    board_begin();
    for (;;) board_step();
}
