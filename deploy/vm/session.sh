#!/bin/sh
# The rest of the guest's first process: brings the interfaces up, runs the command, passes its output and exit code
# on, and switches the guest off. The host listens on three ports: out, err and control. In QEMU, they are virtio ports;
# in user-mode Linux, they are the terminals tty1 to tty3, in raw mode.
bb=/run/snakesim/busybox
own=/run/snakesim
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin

port() {
  # shellcheck disable=SC2154
  if [ "$snakesim_files" = hostfs ]; then
    case $1 in
      out) terminal=/dev/tty1 ;;
      err) terminal=/dev/tty2 ;;
      control) terminal=/dev/tty3 ;;
    esac
    $bb stty raw -echo <$terminal && $bb echo $terminal
    return
  fi
  for entry in /sys/class/virtio-ports/*; do
    read -r name <"$entry/name"
    [ "$name" = "$1" ] && $bb echo "/dev/${entry##*/}"
  done
}

give_up() {
  $bb echo "snakesim: $1" >/dev/console
  $bb poweroff -f
}

$bb mkdir -p /dev/pts /dev/shm $own/tmp
$bb mount -t devpts -o mode=620,ptmxmode=666 devpts /dev/pts
$bb mount -t tmpfs -o mode=1777 shm /dev/shm
$bb chmod 1777 $own/tmp
$bb ln -sf /proc/self/fd /dev/fd
$bb ln -sf /proc/self/fd/0 /dev/stdin
$bb ln -sf /proc/self/fd/1 /dev/stdout
$bb ln -sf /proc/self/fd/2 /dev/stderr
$bb hostname snakesim-vm
$bb ip link set lo up

# interfaces.sh is written for each run: which channels, controllers and network there are.
# The host's shell runs it, because busybox would take its own `ip`, which knows nothing of bit rates.
/bin/sh -ex $own/interfaces.sh >/dev/console 2>&1 || give_up "an interface cannot be brought up; see the last line"

exec 3<>"$(port control)" || give_up "the guest has no control port"
$bb mkfifo $own/out $own/err
# Not straight to the port, which can be opened once only: a command may open /dev/stdout anew. The bytes are counted,
# so that the host knows when it has them all.
$bb tee "$(port out)" <$own/out 3>&- | $bb wc -c >$own/out.count &
out=$!
$bb tee "$(port err)" <$own/err 3>&- | $bb wc -c >$own/err.count &
err=$!
# The host sends names of signals, meant for the whole command.
(while read -r signal <&3; do $bb kill "-$signal" -- "-$(cat $own/pid)"; done) 2>/dev/null &

$bb echo ready >&3
# In the foreground, because a shell starts background commands with SIGINT ignored.
$bb setsid $bb sh -c "echo \$\$ >$own/pid; exec /bin/sh $own/command.sh" </dev/null >$own/out 2>$own/err 3>&-
code=$?

# What the command left running may hold the pipes open; its last words are waited for, it is not.
tries=0
while [ $tries -lt 20 ] && { $bb kill -0 $out || $bb kill -0 $err; } 2>/dev/null; do
  $bb sleep 0.1
  tries=$((tries + 1))
done
$bb sync
$bb echo "exit $code $(cat $own/out.count) $(cat $own/err.count)" >&3
# The host ends the machine when it has read everything.
$bb sleep 30
$bb poweroff -f
