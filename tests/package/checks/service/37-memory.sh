# The service at its MemoryMax, with clients at both sockets and a heater on. The kernel takes the search for the host
# first, and the service goes on. If the kernel takes the program, the guardian switches the heater off.
GROUP=/sys/fs/cgroup/system.slice/pinion-mcu.service
is_reported() { said pinion-mcu -p warning | grep 'the search for the host has ended'; }
came_back() { is_active pinion-mcu && [ "$(pid)" != "$before" ]; }
light
before=$(pid)
score() { cat "/proc/$1/oom_score_adj"; }
is "$(score "$before") $(score "$(guardian)") $(score "$(pgrep -P "$before" -x pinion-search)")" '-900 -1000 500' "the scores"
# As many clients as it lets in, and recordings that nobody reads.
hold 100 60
echo "with everything on: $(($(cat $GROUP/memory.peak 2>/dev/null || cat $GROUP/memory.current) / 1000000)) MB"
[ "$(cat $GROUP/memory.current)" -lt 64000000 ]
# Something in the service takes memory until the kernel kills a process. Then it gives a little back and pauses. The
# kernel may not kill it.
mark
cat >/run/fill.py <<'END'
import os, signal, sys
def kills():
    return [line for line in open(sys.argv[1]) if line.startswith("oom_kill ")]
held, before = [], kills()
while True:
    held.append(bytearray(1 << 18))
    if kills() != before:
        del held[:64]
        os.kill(os.getpid(), signal.SIGSTOP)
        before = kills()
END
(
    echo -1000 >/proc/self/oom_score_adj
    echo $BASHPID >$GROUP/cgroup.procs
    exec python3 /run/fill.py $GROUP/memory.events
) &
fill=$!
until_true 60 grep -q 'State:.*stopped' /proc/$fill/status
until_true 20 is_reported
sleep 1
is_high 3
is "$(pid)" "$before" "the process"
pinion status >/dev/null
# The next one is the program.
kill -CONT $fill
until_true 20 is_low 3
# systemd may have ended it with the rest of the service.
kill -9 $fill || true
until_true 30 came_back
dark
identifies
is_low 3
# The guardian is never taken. (A line that nobody holds falls back to low here, so its log is the proof.)
said | grep 'guardian: .* outputs are driven to their shutdown values'
let_go
rm /run/fill.py
