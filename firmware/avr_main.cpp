// The start of the firmware when it is built without the Arduino IDE.
#include "uvgs_gantry/src/machine.h"

int main() { uvgs::machine::run(); }
