# The package installs, and starts and enables nothing. Its user has its groups, and the devices have theirs.
systemctl is-system-running --wait || true
until_true 30 test -c /dev/gpiochip0
until_true 30 is_active test-chips
not id pinion 2>/dev/null
stat -c '%U:%G %n' /dev/gpiochip0 /dev/watchdog
apt-get -qq update
apt-get install -y --no-install-recommends /share/pinion-mcu.deb
# The simulated printer is another package. Its program lies in /share, too, and would serve for ever.
status=0
said=$(PATH=${PATH%:/share} pinion run --board sim 2>&1) || status=$?
is $status 1 "the exit status without a simulator"
case $said in *'sudo apt install pinion-sim'*) ;; *) fail "without a simulator it says: $said" ;; esac
apt-get install -y /share/pinion-sim.deb
pinion dict --board sim >/dev/null
is "$(systemctl is-enabled pinion-mcu || true)" disabled
is "$(systemctl is-active pinion-mcu || true)" inactive
is "$(id -nG pinion | tr ' ' '\n' | sort | xargs)" "dialout gpio i2c pinion spi tty"
