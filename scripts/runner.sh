#!/bin/sh
# Runs a test program for cargo, with the priority that it has beside guests of the virtual bench (nice 5, scripts/tests.sh):
# tests of the program wait more than they compute and are late without a processor, all others compute.
case "$1" in
    */program-*) exec "$@" ;;
    *) exec nice -n 10 "$@" ;;
esac
