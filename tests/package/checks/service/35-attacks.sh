# What an ordinary user can do against root's commands while the service heats. These commands write through no link of
# that user, run no program with root's rights, print no line that the user may not read, and refuse a file that asks for
# too much. The service and its host notice nothing.
AS=stranger HOME_OF=/home/stranger SECRET=/root/secret.cfg
as() { runuser -u $AS -- "$@"; }
# refused WORDS COMMAND...: the command ends by itself, fails, and says this.
refused() {
    local status=0
    timeout -k 5 60 "${@:2}" </dev/null >/run/attack 2>&1 || status=$?
    is "$status" 1 "the exit status of ${*:2}: $(tail -n 3 /run/attack)"
    grep -qF "$1" /run/attack || { cat /run/attack; false; }
}
kept() { is "$(cat $SECRET; stat -c '%a %U' $SECRET)" $'[x]\nwords of root\n600 root' "$SECRET"; }
printf '[x]\nwords of root\n' >$SECRET
chmod 600 $SECRET
light
dark
until_true 20 leaves_recording
recording=$(recording)
light
before=$(pid)
mark

# Files that commands make. The way to one leads through a link, to the file or to its folder; one folder looks as if
# root's simulated printer had made it.
as ln -s $SECRET $HOME_OF/out.svg
as ln -s /root $HOME_OF/folder
as mkdir $HOME_OF/ours
as touch $HOME_OF/ours/.pinion-sim
as ln -s $SECRET $HOME_OF/ours/variables.cfg
as tee $HOME_OF/printer.cfg >/dev/null <<'END'
[mcu]
serial: /dev/serial/by-id/board
[printer]
kinematics: none
max_velocity: 1
max_accel: 1
[output_pin light]
pin: PA1
END
sed "s|^serial: .*|serial: $HOME_OF/out.svg|" $HOME_OF/printer.cfg >/run/in-place.cfg
others='belongs to another user'
for out in $HOME_OF/out.svg $HOME_OF/folder/secret.cfg; do
    refused "$others" pinion trace "$recording" --svg $out
    refused "$others" pinion dict --board sim -o $out
    refused "$others" pinion sim --toolpath $out
    refused "$others" pinion sim --spi-trace $out
done
refused "$others" pinion trace "$recording" --perfetto $HOME_OF/out.svg
refused "$others" pinion trace "$recording" --vcd $HOME_OF/out.svg
refused "$others" pinion sim $HOME_OF/printer.cfg --folder $HOME_OF/folder/sim
refused "$others" pinion sim $HOME_OF/printer.cfg --folder $HOME_OF/ours
refused "$others" pinion sim /run/in-place.cfg --in-place-pty
kept
is "$(readlink $HOME_OF/out.svg)" $SECRET "the link"

# A printer.cfg is a program: root's trial runs its klippy as its owner. It ends with the trial, whatever ends that.
as mkdir -p $HOME_OF/klipper/klippy
as tee $HOME_OF/klipper/klippy/klippy.py >/dev/null <<END
cat /proc/self/status >$HOME_OF/who
(echo words of klippy >$SECRET; cat $SECRET; kill -9 $before) >$HOME_OF/tried 2>&1
exec sleep 600
END
pinion sim $HOME_OF/printer.cfg --try --real-time --python /bin/sh --klipper $HOME_OF/klipper >/run/trial 2>&1 &
trial=$!
until_true 60 pgrep -u $AS -x sleep
is "$(sed -n 's/^\(CapPrm\|CapEff\|CapAmb\|NoNewPrivs\):\t//p' $HOME_OF/who | sort -u | xargs)" '0000000000000000 1' "klippy's rights"
is "$(awk '/^Uid/ { print $2, $3, $4 }' $HOME_OF/who | tr ' ' '\n' | sort -u)" "$(id -u $AS)" "klippy's user"
is "$(grep -c 'denied\|not permitted' $HOME_OF/tried)" 3 "the number of refusals"
kept
kill -9 $trial
until_true 10 not pgrep -u $AS -x sleep

# A printer of 800 MCUs.
{ cat $HOME_OF/printer.cfg; printf '\n[mcu m%d]\nserial: /dev/ttyACM0\n' {1..799}; } | as tee $HOME_OF/many.cfg >/dev/null
refused 'at most 16 are simulated' pinion sim $HOME_OF/many.cfg

# A card: its links stay on it, its files are not root's because this computer has users with the same numbers, and
# patterns of includes do not keep root's command busy.
CARD=$HOME_OF/card DATA=$HOME_OF/card/home/pi/printer_data/config
as mkdir -p $CARD/proc/device-tree $CARD/boot $CARD/etc/systemd/system $DATA/many
printf 'Raspberry Pi 4 Model B Rev 1.4\0' | as tee $CARD/proc/device-tree/model >/dev/null
mkdir -p /root/outside
echo mine >/root/outside/config.txt
as ln -s /root/outside $CARD/boot/firmware
printf '[mcu host]\nserial: /tmp/klipper_host_mcu\n' | as tee $DATA/printer.cfg >/dev/null
refused 'there is no /boot/firmware/config.txt' pinion add adxl345 --root $CARD --yes
is "$(cat /root/outside/config.txt)" mine
printf '[Service]\nExecStart=/usr/bin/python3 /home/pi/klipper/klippy/klippy.py /home/pi/printer_data/config/printer.cfg\n' |
    as tee $CARD/etc/systemd/system/klipper.service >/dev/null
as ln -s $SECRET $DATA/stolen.cfg
as cp -P $DATA/stolen.cfg $CARD/secret.cfg
printf '[include stolen.cfg]\n[include ../../../../../../../root/secret.cfg]\n' | as tee $DATA/printer.cfg >/dev/null
for command in 'add relay --dry-run' doctor pins; do
    timeout 60 pinion $command --root $CARD >/run/attack 2>&1 || true
    not grep 'words of root' /run/attack
done
as touch $DATA/many/{1..200}.cfg
printf '[include many/x*.cfg]\n%.0s' {1..990} | as tee $DATA/printer.cfg >/dev/null
refused 'the patterns look at more than 100000 names' pinion add relay --root $CARD --dry-run

# All of it happened beside a heater that its host refreshes.
is_high 3
is "$(pid)" "$before" "the process"
is "$(said pinion-mcu -p warning)" "" "a warning in the log"
dark
until_true 10 is_low 3

# A member of the terminal's group comes and goes at any rate. The next host is served.
cat >/run/come.py <<'END'
import os, sys
for _ in range(3000):
    os.close(os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK))
END
klippy python3 /run/come.py $LINK
identifies
is "$(pid)" "$before" "the process"
rm -rf $SECRET /root/outside $HOME_OF/* /run/come.py /run/in-place.cfg /run/attack /run/trial
