# systemd feeds the watchdog, as on Raspberry Pi OS. Pinion's start then fails, and the doctor's command takes the watchdog
# from systemd.
CONFIG=/etc/pinion/pinion.toml
VENDOR_S=/usr/lib/systemd/system.conf.d/40-rpi-enable-watchdog.conf
fresh
systemctl stop pinion-mcu
mkdir -p "${VENDOR_S%/*}" /etc/systemd/system.conf.d
printf '[Manager]\nRuntimeWatchdogSec=1m\n' >$VENDOR_S
# A file in /etc does not count if its name comes first.
printf '[Manager]\nRuntimeWatchdogSec=off\n' >/etc/systemd/system.conf.d/10-watchdog.conf
systemctl daemon-reexec
is "$(systemctl show -P RuntimeWatchdogUSec)" 1min "the timeout of systemd's watchdog"
cp -p $CONFIG /run/pinion.toml
echo 'watchdog = true' >>$CONFIG
mark
not systemctl start pinion-mcu
systemctl stop pinion-mcu
said | grep -- '-w: /dev/watchdog cannot be opened: .* on Raspberry Pi OS systemd: "sudo pinion doctor" has the command'
not runuser -u pinion -- pinion run --check --config $CONFIG >/run/checked
grep "error.*RuntimeWatchdogSec=1m in $VENDOR_S" /run/checked
doctor >/run/findings
grep -A 1 "error.*RuntimeWatchdogSec=1m in $VENDOR_S" /run/findings
command=$(sed -n "s/^ *-> \(printf .*daemon-reexec\); or watchdog = false.*/\1/p" /run/findings)
[ -n "$command" ]
bash -ec "$command"
is "$(systemctl show -P RuntimeWatchdogUSec)" 0 "the timeout of systemd's watchdog"
fresh
mark
systemctl start pinion-mcu
identifies
said | grep '/dev/watchdog resets this computer'
doctor >/run/findings
grep 'ok .*/dev/watchdog is there' /run/findings
systemctl stop pinion-mcu
cp -p /run/pinion.toml $CONFIG
rm $VENDOR_S /etc/systemd/system.conf.d/*.conf
systemctl daemon-reexec
