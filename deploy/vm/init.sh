#!/bin/busybox sh
# The guest's first process: loads modules, lays the host's file system out as the root, and goes on in session.sh.
# The kernel turns `snakesim_modules=vcan,can` of its command line into a variable of ours.
bb=/bin/busybox
$bb mount -t devtmpfs dev /dev
$bb mount -t proc proc /proc
$bb mount -t sysfs sys /sys

give_up() {
  $bb echo "snakesim: $1" >/dev/ttyS0
  $bb poweroff -f
}

# Already in the order in which they need each other.
# shellcheck disable=SC2154
for module in $(IFS=,; for name in $snakesim_modules; do $bb echo "$name"; done); do
  $bb insmod "/modules/$module.ko" 2>/dev/ttyS0 || give_up "the guest cannot load $module"
done

# The host's files, read-only; what the guest writes stays in its memory. cache=loose: nobody else writes there
# that the guest would have to notice, and imports are several times faster.
options=trans=virtio,version=9p2000.L,msize=512000,cache=loose
$bb mount -t 9p -o "ro,$options" root /host || give_up "the guest cannot mount the host's files"
$bb mount -t tmpfs layer /layer
$bb mkdir /layer/upper /layer/work
$bb mount -t overlay -o lowerdir=/host,upperdir=/layer/upper,workdir=/layer/work root /new \
  || give_up "the guest cannot make its root writable"

# Folders of the host that the guest may really write; each is a share of its own, mounted over its own path.
number=0
while IFS= read -r path; do
  $bb mount -t 9p -o "rw,$options" "share$number" "/new$path" || give_up "the guest cannot mount $path"
  number=$((number + 1))
done </run.d/shares

for place in dev proc sys; do
  $bb mkdir -p "/new/$place"
  $bb mount --move "/$place" "/new/$place"
done
$bb mkdir -p /new/run
$bb mount -t tmpfs -o mode=755 run /new/run
$bb mkdir -p /new/run/snakesim
$bb cp /bin/busybox /run.d/* /new/run/snakesim/
exec $bb switch_root /new /run/snakesim/busybox sh /run/snakesim/session.sh
