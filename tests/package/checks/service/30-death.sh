# If the program or its guardian dies or hangs, the heater goes off, and the service comes back. (tests/kernel has the
# other ways to die or hang. systemd sees each of them as one of these.)
# dies SECONDS SIGNAL WHOM: the heater stays on for at most SECONDS. (Eight, because systemd would end a hanging program
# after ten. tests/kernel measures the guardian's time to the millisecond.)
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
dies 8 STOP guardian
# Its core hangs: by a signal that only a program under test accepts.
mkdir -p /run/systemd/system/pinion-mcu.service.d
printf '[Service]\nEnvironment=PINION_TEST_HANG=1\n' >/run/systemd/system/pinion-mcu.service.d/hang.conf
systemctl daemon-reload
systemctl restart pinion-mcu
dies 8 USR2 pid
rm -r /run/systemd/system/pinion-mcu.service.d
systemctl daemon-reload
# Each death left a recording, which everybody may read.
says() { klippy pinion trace --list | grep -q "$1"; }
until_true 10 says 'Pinion died'
until_true 10 says 'Pinion hung'
is "$(stat -c '%U %a' /var/lib/pinion)" "pinion 755" "the folder of recordings"
