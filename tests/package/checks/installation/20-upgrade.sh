# The configuration through downgrades and upgrades: an edited file stays, and a missing one is created again.
export DEBIAN_FRONTEND=noninteractive
CONFIG=/etc/pinion/pinion.toml
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
is_active pinion-mcu@second
apt-get purge -y pinion-mcu </dev/null
not is_active pinion-mcu@second
apt-get install -y /run/before.deb </dev/null
echo 'log_level = "debug"' >>$CONFIG
echo 'PINION_OPTIONS="--margin 300"' >>/etc/default/pinion-mcu
apt-get install -y /share/pinion-mcu.deb </dev/null
is "$(dpkg-query -W -f '${Status}' pinion-mcu)" 'install ok installed' "the package"
grep -q '^log_level = "debug"' $CONFIG
grep -q 'margin 300' /etc/default/pinion-mcu
systemctl start pinion-mcu
identifies
apt-get purge -y pinion-mcu </dev/null
[ ! -e $CONFIG ]
[ ! -e /etc/default/pinion-mcu ]
