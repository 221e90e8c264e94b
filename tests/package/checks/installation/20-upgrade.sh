# An upgrade keeps a running print and edited files, and asks no questions. A restart then runs the new unit.
export DEBIAN_FRONTEND=noninteractive
CONFIG=/etc/pinion/pinion.toml
light
before=$(pid)
echo 'PINION_OPTIONS="--log-level debug"' >/etc/default/pinion-mcu
apt-get install -y /share/later.deb </dev/null 2>&1 | tee /run/apt
grep -q 'Pinion still runs as it was' /run/apt
is "$(pid)" "$before" "the process"
is_high 3
is "$(systemctl show -P NeedDaemonReload pinion-mcu)" no NeedDaemonReload
grep -q 'log-level debug' /etc/default/pinion-mcu
# The file was as the former package had delivered it, so it was replaced.
grep -q '^# of the later package' $CONFIG
# The same host still refreshes the heater.
sleep 4
is_high 3
dark
systemctl restart pinion-mcu
is "$(systemctl show -P Description pinion-mcu)" 'The later unit' "the unit"
identifies
rm /etc/default/pinion-mcu

# An edited file stays. A missing file is created again.
echo '# edited' >>$CONFIG
apt-get install -y --allow-downgrades /share/pinion-mcu.deb </dev/null
grep -q '^# edited' $CONFIG
rm $CONFIG
apt-get install -y /share/later.deb </dev/null
cmp $CONFIG /usr/share/pinion-mcu/pinion.toml

# An older package that had the files as conffiles: edited files stay, and no question is asked.
dpkg-deb -R /share/pinion-mcu.deb /run/before
sed -i 's/^Version: /&0~/' /run/before/DEBIAN/control
rm /run/before/DEBIAN/postinst /run/before/DEBIAN/postrm
install -D /run/before/usr/share/pinion-mcu/pinion.toml /run/before/$CONFIG
install -D /dev/null /run/before/etc/default/pinion-mcu
printf '%s\n' $CONFIG /etc/default/pinion-mcu >/run/before/DEBIAN/conffiles
dpkg-deb --root-owner-group -Znone -b /run/before /run/before.deb
apt-get purge -y pinion-mcu </dev/null
apt-get install -y /run/before.deb </dev/null
echo 'log_level = "debug"' >>$CONFIG
echo 'PINION_OPTIONS="--margin 300"' >>/etc/default/pinion-mcu
apt-get install -y /share/pinion-mcu.deb </dev/null
is "$(dpkg-query -W -f '${Status}' pinion-mcu)" 'install ok installed' "the package"
grep -q '^log_level = "debug"' $CONFIG
grep -q 'margin 300' /etc/default/pinion-mcu
systemctl start pinion-mcu
identifies
# The next checks need the package as delivered.
apt-get purge -y pinion-mcu </dev/null
[ ! -e $CONFIG ]
[ ! -e /etc/default/pinion-mcu ]
apt-get install -y /share/later.deb </dev/null
systemctl start pinion-mcu
