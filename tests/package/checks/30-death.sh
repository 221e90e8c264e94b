# However the program or its guardian dies or hangs, the heater goes off, and the service comes back.
# dies SECONDS SIGNAL WHOM: for so long, at most, the heater stays on. (Eight, as systemd would end a program
# that hangs after ten. How fast the guardian is to the millisecond, tests/kernel shows.)
dies() {
    light
    before=$(pid)
    kill "-$2" "$($3)"
    until_true "$1" is_low 3
    until_true 30 came_back
    dark
    identifies
    is_low 3
    echo "SIG$2 to the $3: ok"
}
came_back() { is_active pinion-mcu && [ "$(pid)" != "$before" ]; }
dies 8 KILL pid
dies 8 STOP pid
dies 8 KILL guardian
dies 8 STOP guardian
# Its core hangs: by a signal that only a program under test takes.
mkdir -p /run/systemd/system/pinion-mcu.service.d
printf '[Service]\nEnvironment=PINION_TEST_HANG=1\n' >/run/systemd/system/pinion-mcu.service.d/hang.conf
systemctl daemon-reload
systemctl restart pinion-mcu
dies 8 USR2 pid
rm -r /run/systemd/system/pinion-mcu.service.d
systemctl daemon-reload
