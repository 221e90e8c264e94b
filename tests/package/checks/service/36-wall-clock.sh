# The wall clock jumps by hours, both ways, while a heater is on. Time synchronization makes such jumps on a computer
# without a battery for its clock. Neither the service nor its watchdog notices, and a recording has the clock's time.
jump() { date -s "@$(($(date +%s) + $1 * 3600))" >/dev/null; }
seconds() { python3 -c 'import sys, time; print(int(time.clock_gettime(time.CLOCK_MONOTONIC)))'; }
up() { pinion status --json | python3 -c 'import json, sys; print(int(json.load(sys.stdin)["uptime_s"]))'; }
near() { [ $(($1 - $2)) -ge -"$3" ] && [ $(($1 - $2)) -le "$3" ] || fail "$4: $1 is not $2"; }
fresh
systemctl restart pinion-mcu
light
before=$(pid)
started=$(($(seconds) - $(up)))
for hours in 5 -11 6; do
    jump $hours
    # Longer than the heater stays on without a refresh.
    sleep 3.5
    is_high 3
    near $(($(seconds) - $(up))) "$started" 3 "when it started, by its status"
done
is "$(pid)" "$before" "the process"
is "$(journalctl --sync; journalctl -q -o cat -p warning "_PID=$before")" "" "a warning in the log"
# The newest recording has the time of the clock, wherever that stands.
listed() { { pinion trace --list 2>/dev/null || true; } | head -n 1; }
later() { [ "$(listed)" != "$last" ]; }
for hours in 5 -5; do
    jump $hours
    last=$(listed)
    dark
    until_true 20 later
    is_low 3
    newest=$(listed)
    near "$(date -ud "${newest:0:19}" +%s)" "$(date +%s)" 30 "the time of the newest recording"
    light
done
dark
systemctl stop pinion-mcu
