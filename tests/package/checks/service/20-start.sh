# The started service is ready at once, in real time, with its memory locked, as its own user.
mark
systemctl start pinion-mcu
is "$(systemctl show -P NotifyAccess pinion-mcu)" main NotifyAccess
is "$(stat -c %U "/proc/$(pid)")" pinion "the process's user"
core=$(ps -L -o tid=,comm= -p "$(pid)" | awk '$2 == "core" { print $1 }')
chrt -p "$core" | grep SCHED_FIFO
[ "$(awk '/^VmLck/ { print $2 }' "/proc/$(pid)/status")" -gt 1000 ]
guardian >/dev/null
is "$(readlink $LINK)" /run/pinion/klipper_host_mcu "the link"
# klippy's user may connect. A user who is not in the group may not.
identifies $LINK HEATER
not runuser -u stranger -- sh -c ": >$LINK" 2>/run/stranger
grep -i 'permission denied' /run/stranger
# None of this causes a warning, and neither does stopping an MCU that is not configured.
systemctl stop pinion-mcu
is "$(said pinion-mcu -p warning)" "" "a warning in the log"
[ ! -e $LINK ]
[ ! -L $LINK ]
