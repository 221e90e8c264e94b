# What ordinary users can do against the service. Processes of another user that have the names of a Pinion, a klippy
# and a login change no advice of doctor. A member of the group spoils the terminal and holds the sockets, and anybody
# takes the link's place. Nobody but root may look into the search for the host, not even a process of its own user.
fresh
systemctl start pinion-mcu
CONFIG=/home/stranger/printer.cfg
printf '[mcu host]\nserial: %s\n[tmc2209 a]\nuart_pin: host:serial/../vda\n' $LINK >$CONFIG
doctor >/run/advice-before
# (runuser would stay as a process of root with the same words.)
stranger() { setpriv --reuid=stranger --regid=stranger --init-groups "$@" & }
for name in pinion klippy.py klipper_mcu agetty; do stranger bash -c "exec -a $name sleep infinity"; done
# This one names a configuration.
printf 'sleep infinity\n' >/home/stranger/klippy.py
stranger sh /home/stranger/klippy.py $CONFIG
until_true 10 pgrep -u stranger -f klippy.py
until_true 10 pgrep -u stranger -f klipper_mcu
until_true 10 pgrep -u stranger -f agetty
doctor >/run/advice-after
grep 'are called like a Pinion or a klippy, and do not count here: ' /run/advice-after
is "$(grep -v -e 'and do not count here: ' -e 'if one of them is yours, have a service start it' /run/advice-after)" \
    "$(cat /run/advice-before)" "doctor's advice"
pkill -u stranger
wait || true
rm /home/stranger/klippy.py $CONFIG /run/advice-*

# A user outside of the group reaches neither the terminal nor the sockets, and plants nothing where the service writes.
is "$(sockets | wc -l)" 2 "the number of sockets"
for file in $LINK $(sockets); do
    not setpriv --reuid=stranger --regid=stranger --init-groups test -w "$file"
done
for folder in /run/pinion /var/lib/pinion; do
    not setpriv --reuid=stranger --regid=stranger --init-groups ln -s /etc/shadow $folder/planted 2>/dev/null
done
# A member of the group closes the terminal to others, stops it and leaves. The next host is served by the same process.
before=$(pid)
cat >/run/spoil.py <<'END'
import fcntl, os, sys, termios, time
port = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
fcntl.ioctl(port, termios.TIOCEXCL)
os.write(port, b"\x7e")
termios.tcflow(port, termios.TCOOFF)
time.sleep(2)
END
klippy python3 /run/spoil.py $LINK
until_true 20 identifies $LINK HEATER
# Members of the group hold each socket open many times. Root still reads the status, and a host is served.
hold 200 120
pinion status >/run/status
grep klipper_host_mcu /run/status
identifies
is "$(pid)" "$before" "the process"
let_go
wait || true
# The link's place is taken before the start: by a link to a file of root's, ...
evil='sudo-usermod-stranger'
shadow() { sha256sum /etc/shadow; stat -c '%a %U %G' /etc/shadow; }
kept=$(shadow)
systemctl stop pinion-mcu
setpriv --reuid=stranger --regid=stranger --init-groups ln -s /etc/shadow $LINK
systemctl start pinion-mcu
is "$(readlink $LINK)" /run/pinion/klipper_host_mcu "the link"
identifies
is "$(shadow)" "$kept" "root's file"
# ... by a pipe, which nobody writes to, ...
systemctl stop pinion-mcu
mark
setpriv --reuid=stranger --regid=stranger --init-groups mkfifo -m 666 $LINK
not systemctl start pinion-mcu
said | grep "$LINK exists but is not a symbolic link: remove it" >/dev/null
rm $LINK
until_true 20 is_active pinion-mcu
# ... and by a link to a terminal that another program serves. Its text has a line for the log in it.
systemctl stop pinion-mcu
mark
cat >/run/squat.py <<'END'
import os, sys, time
_, slave = os.openpty()
folder = "/tmp/x\n<0>" + sys.argv[2]
os.makedirs(folder, exist_ok=True)
os.symlink(folder + "/../.." + os.ttyname(slave), sys.argv[1])
time.sleep(600)
END
stranger python3 /run/squat.py $LINK $evil
until_true 20 test -L $LINK
not systemctl start pinion-mcu
said | grep "$LINK leads to /dev/pts/[0-9]*, which another program serves" >/dev/null
not grep -F $evil <(said)
# Doctor shows where the link leads, in its own line and without the line's end. It has no command with these words.
doctor >/run/advice
not grep "^$evil\|^ .*sudo .*$evil\|^<0>" /run/advice
pkill -u stranger
wait || true
until_true 30 is_active pinion-mcu
identifies
rm -r /tmp/x* $LINK.* /run/spoil.py /run/squat.py /run/status /run/advice 2>/dev/null || true

search=$(pgrep -P "$(pid)" -x pinion-search)
own() { setpriv --reuid=pinion --regid=pinion --clear-groups "$@"; }
own cat "/proc/$search/stat" >/dev/null
not own cat "/proc/$search/environ" 2>/dev/null
# (Its own user may list the numbers of its files, but not what they are.)
not own readlink "/proc/$search/fd/$(ls "/proc/$search/fd" | head -n 1)"
systemctl stop pinion-mcu
