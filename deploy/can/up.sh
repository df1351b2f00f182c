#!/bin/sh
# Brings a CAN interface up, until the next restart of the machine; --help explains how.
set -eu

bitrate=1000000
queue=64 # as in systemd/40-can.link, where the reason stands

usage() {
  cat <<TEXT
Usage: $0 INTERFACE [BITRATE]
       $0 --down INTERFACE

Brings a CAN interface up, until the next restart of the machine. Needs root.

  $0 can0             a real controller, at $bitrate bit/s; it stays off the bus after bus-off
  $0 can0 500000      the same, at another bit rate
  $0 vcan0            a virtual bus, made first if it is not there
  $0 --down can0      takes the interface down; after bus-off: down, then up again

For an interface that is there after every start of the machine, see README.md beside this file.
TEXT
}

fail() {
  echo "$0: $1" >&2
  exit 1
}

given=$*
down=no
case "${1:-}" in
  -h | --help) usage; exit 0 ;;
  --down) down=yes; shift ;;
esac
interface=${1:-}
case "$interface" in
  *[!a-z0-9]*) usage >&2; exit 2 ;;
  vcan[0-9]*) virtual=yes ;;
  can[0-9]*) virtual=no ;;
  *) usage >&2; exit 2 ;;
esac
[ $# -le 2 ] || { usage >&2; exit 2; }
bitrate=${2:-$bitrate}
case "$bitrate" in
  *[!0-9]*) fail "the bit rate is a number of bits per second, such as 1000000, not $bitrate" ;;
esac
PATH=$PATH:/usr/sbin:/sbin
command -v ip >/dev/null || fail "there is no ip command; install the package iproute2"
[ "$(id -u)" -eq 0 ] || fail "needs root. Run: sudo $0 $given"

if [ $down = yes ]; then
  exec ip link set "$interface" down
fi

if ! ip link show "$interface" >/dev/null 2>&1; then
  [ $virtual = yes ] || fail "there is no $interface. Is the adapter plugged in? \`dmesg | tail\` shows what the kernel saw"
  # Without modprobe the kernel may still have it built in, or load it itself.
  modprobe vcan 2>/dev/null || true
  ip link add "$interface" type vcan || fail "this kernel has no vcan. Run your command by deploy/vm/with_vcan.py instead"
fi

if [ $virtual = no ]; then
  # The bit rate can be set only while the interface is down.
  ip link set "$interface" down
  ip link set "$interface" type can bitrate "$bitrate" restart-ms 0
fi
ip link set "$interface" txqueuelen $queue
ip link set "$interface" up
ip -details link show "$interface"
