// Firmware of a three-axis gantry for optical measurements. Everything is in src/; see ../README.md and ../PROTOCOL.md.
// Board: Arduino Uno, Nano or any other ATmega328P at 16 MHz.
#include "src/machine.h"

void setup() {}

void loop() { uvgs::machine::run(); }
