// Arduino sketch: everything is in the C files beside it. Board: Arduino Nano (ATmega328P).
#include "board.h"

void setup() { board_begin(); }

void loop() { board_step(); }
