# An upgrade leaves the print that runs, and what was edited; a restart then runs the new unit.
light
before=$(pid)
echo '# edited' >>/etc/default/pinion-mcu
apt-get install -y -o Dpkg::Options::=--force-confdef /share/later.deb 2>&1 | tee /run/apt
grep -q 'Pinion still runs as it was' /run/apt
is "$(pid)" "$before" "the process"
is_high 3
is "$(systemctl show -P NeedDaemonReload pinion-mcu)" no NeedDaemonReload
grep -q '^# edited' /etc/default/pinion-mcu
# It is still refreshed, by the same host.
sleep 4
is_high 3
dark
systemctl restart pinion-mcu
is "$(systemctl show -P Description pinion-mcu)" 'The later unit' "the unit"
identifies
