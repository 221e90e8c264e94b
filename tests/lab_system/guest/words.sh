# SPDX-License-Identifier: GPL-3.0-or-later
# The words that the checks are written with. A check ends at the first command that fails.
set -Eeuo pipefail
trap 'echo "failed: line $LINENO: $BASH_COMMAND"; journalctl -n 25 --no-pager -u "pinion-mcu*" -u klipper-mcu 2>/dev/null' ERR
export PATH=$PATH:/share

LINK=/tmp/klipper_host_mcu
CHIP=/sys/devices/platform/gpio-sim.0/gpiochip0

# bash goes on after a "!" command that fails its check, and after an "a && b" whose a fails: neither is used.
not() { if "$@"; then fail "it succeeded: $*"; fi; }
fail() { echo "$*"; false; }
# is VALUE WANTED [OF WHAT]
is() { [ "$1" = "$2" ] || fail "${3:-} is \"$1\", not \"$2\""; }
# until_true SECONDS COMMAND...
until_true() {
    local end=$((SECONDS + $1)); shift
    until "$@" >/dev/null 2>&1; do
        [ $SECONDS -lt $end ] || fail "not within its time: $*"
        sleep 0.1
    done
}
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
    fresh
    systemctl start pinion-mcu
    klippy /share/host light $LINK HEATER >/run/light 2>&1 &
    until_true 20 grep -q lit /run/light
    until_true 5 is_high 3
}
dark() { pkill -f '/share/host light' || true; }
# What the journal has of the service, since the mark that `mark` sets.
mark() { journalctl --sync; journalctl -n 1 --show-cursor -q | sed -n 's/^-- cursor: //p' >/run/mark; }
said() { journalctl --sync; journalctl --after-cursor="$(cat /run/mark)" -o cat -u "${1:-pinion-mcu}" "${@:2}"; }
