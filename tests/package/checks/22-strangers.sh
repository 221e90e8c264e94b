# Processes of another user that have the names of a Pinion, a klippy and a login change no advice of doctor. Nobody but
# root may look into the search for the host, not even a process of its own user.
fresh
systemctl start pinion-mcu
CONFIG=/home/stranger/printer.cfg
printf '[mcu host]\nserial: %s\n[tmc2209 a]\nuart_pin: host:serial/../vda\n' $LINK >$CONFIG
# The measurement differs each time.
advice() { { pinion doctor || true; } | sed '/^latency/,$d'; }
advice >/run/advice-before
# (runuser would stay as a process of root with the same words.)
stranger() { setpriv --reuid=stranger --regid=stranger --init-groups "$@" & }
for name in pinion klippy.py klipper_mcu agetty; do stranger bash -c "exec -a $name sleep infinity"; done
# This one names a configuration.
printf 'sleep infinity\n' >/home/stranger/klippy.py
stranger sh /home/stranger/klippy.py $CONFIG
until_true 10 pgrep -u stranger -f klippy.py
until_true 10 pgrep -u stranger -f klipper_mcu
until_true 10 pgrep -u stranger -f agetty
advice >/run/advice-after
grep 'have processes with the names of a Pinion or a klippy, which do not count here: ' /run/advice-after
is "$(grep -v -e 'which do not count here: ' -e 'if one of them is yours, have a service start it' /run/advice-after)" \
    "$(cat /run/advice-before)" "doctor's advice"
pkill -u stranger
wait || true
rm /home/stranger/klippy.py $CONFIG /run/advice-*

search=$(pgrep -P "$(pid)" -x pinion-search)
own() { setpriv --reuid=pinion --regid=pinion --clear-groups "$@"; }
own cat "/proc/$search/stat" >/dev/null
not own cat "/proc/$search/environ" 2>/dev/null
# (Its own user may list the numbers of its files, but not what they are.)
not own readlink "/proc/$search/fd/$(ls "/proc/$search/fd" | head -n 1)"
systemctl stop pinion-mcu
