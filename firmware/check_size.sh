#!/bin/sh
# check_size.sh ELF FLASH_BYTES RAM_BYTES: print the size of an AVR program; fail when it is over.
set -eu
avr-size "$1" | awk -v flash_limit="$2" -v ram_limit="$3" 'NR == 2 {
  flash = $1 + $2; ram = $2 + $3
  printf "flash %d of %d bytes, RAM %d of %d bytes\n", flash, flash_limit, ram, ram_limit
  exit flash > flash_limit || ram > ram_limit
}'
