# After the removal the service is stopped and disabled. The purge leaves its user and groups, as the README says.
fresh
systemctl enable --now pinion-mcu
apt-get remove -y pinion-mcu
not is_active pinion-mcu
[ ! -e /usr/bin/pinion ]
[ ! -L $LINK ]
[ -e /etc/pinion/pinion.toml ]
[ ! -e /run/pinion ]
is "$(systemctl list-units --all --plain --no-legend 'pinion-mcu*')" "" "the units that are there"
[ ! -L /etc/systemd/system/multi-user.target.wants/pinion-mcu.service ]
# The user must remove the configuration of an instance.
rm -f /etc/pinion/second.toml
apt-get purge -y pinion-mcu pinion-sim
[ ! -e /etc/pinion ]
id pinion
left=$(find / -xdev \( -path /proc -o -path /sys -o -path /share -o -path /var/log -o -path /run \) -prune -o \
    -iname '*pinion*' -print)
is "$left" "" "what is left"
