# SPDX-License-Identifier: GPL-3.0-or-later
# The functions of the checks. A check ends at the first command that fails.
set -Eeuo pipefail
trap 'echo "failed: line $LINENO: $BASH_COMMAND"; journalctl -n 25 --no-pager -u "pinion-mcu*" -u klipper-mcu 2>/dev/null' ERR
export PATH=$PATH:/share

LINK=/tmp/klipper_host_mcu
CHIP=/sys/devices/platform/gpio-sim.0/gpiochip0

# bash continues after a "!" command that fails its check, and after "a && b" when a fails. So the checks use neither.
not() { if "$@"; then fail "it succeeded: $*"; fi; }
fail() { echo "$*"; false; }
# is VALUE WANTED [OF WHAT]
is() { [ "$1" = "$2" ] || fail "${3:-} is \"$1\", not \"$2\""; }
# until_true SECONDS COMMAND...: asks rarely after a second, because each question takes the emulated processor long.
until_true() {
    local begin=$SECONDS limit=$1; shift
    until "$@" >/dev/null 2>&1; do
        [ $((SECONDS - begin)) -lt "$limit" ] || fail "not within its time: $*"
        if [ $((SECONDS - begin)) -le 1 ]; then sleep 0.1; else sleep 0.5; fi
    done
}
# What takes two seconds is left out.
doctor() { pinion doctor --no-latency "$@" || true; }
level() { cat "$CHIP/sim_gpio$1/value"; }
is_low() { [ "$(level "$1")" = 0 ]; }
is_high() { [ "$(level "$1")" = 1 ]; }
pid() { systemctl show -P MainPID pinion-mcu; }
guardian() { pgrep -P "$(pid)" -x pinion-guardian; }
klippy() { runuser -u klippy -- "$@"; }
identifies() { klippy timeout 20 /share/host identify "${1:-$LINK}" ${2:+"$2"}; }
is_active() { systemctl --quiet is-active "$1"; }
fresh() { systemctl reset-failed 'pinion-mcu*' 'klipper-mcu*' 2>/dev/null || true; }
# Starts the service, if it does not run, and a host that lights the heater.
light() {
    dark
    fresh
    systemctl start pinion-mcu
    klippy /share/host light $LINK HEATER >/run/light 2>&1 &
    until_true 20 grep -q lit /run/light
    until_true 5 is_high 3
}
dark() { pkill -f '/share/host light' || true; }
sockets() { ls /run/pinion/*.sock /run/pinion/*.trace; }
# hold COUNT SECONDS: klippy's user opens each socket COUNT times, within that time, and keeps it open.
hold() {
    cat >/run/hold.py <<'END'
import socket, sys, time
held = []
for path in sys.argv[2:]:
    for _ in range(int(sys.argv[1])):
        one = socket.socket(socket.AF_UNIX)
        one.settimeout(5)
        try:
            one.connect(path)
        except OSError:
            pass
        held.append(one)
print("held", flush=True)
time.sleep(600)
END
    klippy python3 /run/hold.py "$1" $(sockets) >/run/held &
    until_true "$2" grep -q held /run/held
}
let_go() {
    pkill -u klippy -f hold.py
    rm /run/hold.py /run/held
}
# The newest recording. The heater's host is gone, so the MCU stops and leaves one.
recording() { find /var/lib/pinion -name '*.trace' -newer /run/light | head -n 1; }
leaves_recording() { [ -n "$(recording)" ]; }
# The journal of the service since the mark that `mark` sets.
# (Not by a cursor: with a filter, journalctl --after-cursor omits the first line that the filter passes.)
mark() { date +@%s.%6N >/run/mark; }
said() { journalctl --sync; journalctl -q --since="$(cat /run/mark)" -o cat -u "${1:-pinion-mcu}" "${@:2}"; }

# The input of a user who accepts all defaults.
ENTERS=/run/enters
printf '\n%.0s' {1..200} >$ENTERS

# pi, a new user with a clone, who may do anything with sudo.
new_user() {
    if id pi >/dev/null 2>&1; then userdel -rf pi; fi
    useradd -m -s /bin/bash pi
    # Any system has these, but this one does not: sudo looks up the name of its computer.
    mkdir -p /etc/apt/sources.list.d
    grep -q guest /etc/hosts || echo 127.0.1.1 guest >>/etc/hosts
    echo 'pi ALL=(ALL) NOPASSWD: ALL' >/etc/sudoers.d/pi
    cp -r /share/tree /home/pi/pinion
    chown -R pi: /home/pi/pinion
}
# A system without the package, and a new user.
bare() {
    until_true 60 is_active test-chips
    apt-get -qq update
    fresh
    for package in pinion-mcu pinion-sim; do
        if dpkg -s $package >/dev/null 2>&1; then apt-get -qq purge -y $package; fi
    done
    apt-get -qq autoremove -y --purge libiio0
    new_user
}
# The result of docs/guide/install.md: the package is installed, its service runs, and the user is in the group tty.
installed() {
    fresh
    if is_as_delivered; then
        new_user
    else
        bare
        apt-get -qq install -y /share/pinion-mcu.deb
    fi
    if ! dpkg -s pinion-sim >/dev/null 2>&1; then apt-get -qq install -y /share/pinion-sim.deb; fi
    usermod -aG tty pi
    systemctl enable pinion-mcu
    systemctl restart pinion-mcu
}
is_as_delivered() {
    [ "$(dpkg-query -W -f '${Version}' pinion-mcu 2>/dev/null)" = "$(dpkg-deb -f /share/pinion-mcu.deb Version)" ] &&
        [ -z "$(dpkg --verify pinion-mcu)" ] && [ ! -e /etc/default/pinion-mcu ] &&
        cmp -s /etc/pinion/pinion.toml /usr/share/pinion-mcu/pinion.toml
}
# page NAME: tries its commands, block by block, each in its own session, in the folder of the clone. Every question,
# for example of apt, is answered with Enter.
page() {
    local block status
    for block in /share/pages/"$1"/*; do
        echo "--- $1, line $((10#$(basename "${block%.*}")))"
        case $block in
        *.not-tried) instead "$(cat "$block")" ;;
        *.sh)
            status=0
            runuser -l pi -c "cd pinion && exec timeout -k 5 240 bash -ev $block" <$ENTERS 2>&1 || status=$?
            [ $status = 0 ] || fail "status $status"
            ;;
        esac
    done
}
# The results of commands that cannot be tried: `make deb` makes a package, and after `git pull` a later one.
instead() {
    local deb=/home/pi/pinion/target/deb
    case $1 in
    *'git pull'*)
        rm -rf "$deb"
        install -D -m 644 /share/later.deb "$deb/$(deb_name /share/later.deb)"
        ;;
    *'make deb'*)
        for package in /share/pinion-mcu.deb /share/pinion-sim.deb; do
            install -D -m 644 $package "$deb/$(deb_name $package)"
        done
        ;;
    esac
}
deb_name() { dpkg-deb --show --showformat='${Package}_${Version}_${Architecture}.deb' "$1"; }
