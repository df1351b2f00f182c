#!/bin/busybox sh
# The guest's first process: loads modules, lays the host's file system out as the root, and goes on in session.sh.
# The kernel turns `snakesim_modules=vcan,can` and `snakesim_files=hostfs` of its command line into variables of ours.
bb=/bin/busybox
$bb mount -t devtmpfs dev /dev
$bb mount -t proc proc /proc
$bb mount -t sysfs sys /sys

give_up() {
  $bb echo "snakesim: $1" >/dev/console
  $bb poweroff -f
}

# Already in the order in which they need each other.
# shellcheck disable=SC2154
for module in $(IFS=,; for name in $snakesim_modules; do $bb echo "$name"; done); do
  $bb insmod "/modules/$module.ko" 2>/dev/console || give_up "the guest cannot load $module"
done

# mount_host PATH FLAG PLACE SHARE: mounts a folder of the host. FLAG is ro or rw.
# User-mode Linux opens the files of the host itself. QEMU shares each folder by 9p, under the name SHARE.
# cache=loose: nobody else writes there that the guest would have to notice, and imports are several times faster.
mount_host() {
  # shellcheck disable=SC2154
  case $snakesim_files in
    hostfs) $bb mount -t hostfs -o "$2,$1" "$4" "$3" ;;
    *) $bb mount -t 9p -o "$2,trans=virtio,version=9p2000.L,msize=512000,cache=loose" "$4" "$3" ;;
  esac
}

# The host's files, read-only; what the guest writes stays in its memory.
mount_host / ro /host root || give_up "the guest cannot mount the host's files"
$bb mount -t tmpfs layer /layer
$bb mkdir /layer/upper /layer/work
$bb mount -t overlay -o lowerdir=/host,upperdir=/layer/upper,workdir=/layer/work root /new \
  || give_up "the guest cannot make its root writable"

# Folders of the host that the guest may really write; each is mounted over its own path.
number=0
while IFS= read -r path; do
  mount_host "$path" rw "/new$path" "share$number" || give_up "the guest cannot mount $path"
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
