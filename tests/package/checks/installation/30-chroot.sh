# The package in a root folder without a running systemd, in which people make images of systems: this disk, without the
# file systems that are mounted on it.
export DEBIAN_FRONTEND=noninteractive
ROOT=/run/chroot
inside() { chroot $ROOT /usr/bin/env PATH="$PATH" "$@" </dev/null; }
# The configuration of an instance is its owner's, and stays.
configured() { find /etc/pinion 2>/dev/null | sort; }
not grep -q 'pinion\.toml' <(configured)
before=$(configured)
cp /share/pinion-mcu.deb /share/pinion-sim.deb /srv/
mkdir $ROOT
mount --bind / $ROOT
[ ! -e $ROOT/run/systemd/system ]
[ ! -e $ROOT/proc/self ]
inside apt-get install -y /srv/pinion-mcu.deb /srv/pinion-sim.deb
is "$(inside dpkg-query -W -f '${Status}' pinion-mcu)" 'install ok installed' "the package"
is "$(inside dpkg --audit)" '' "what dpkg finds"
inside id pinion
cmp $ROOT/etc/pinion/pinion.toml /usr/share/pinion-mcu/pinion.toml
# An image has the service enabled. It starts at the first boot.
inside systemctl enable pinion-mcu
[ -L $ROOT/etc/systemd/system/multi-user.target.wants/pinion-mcu.service ]
not is_active pinion-mcu
# A program that looks at the computer ends, too.
(inside pinion doctor || true) | grep service
inside apt-get purge -y pinion-mcu pinion-sim
is "$(configured)" "$before" "what is left in /etc/pinion"
[ ! -L $ROOT/etc/systemd/system/multi-user.target.wants/pinion-mcu.service ]
umount $ROOT
rmdir $ROOT
rm /srv/pinion-*.deb
systemctl daemon-reload
apt-get install -y /share/pinion-mcu.deb /share/pinion-sim.deb
systemctl start pinion-mcu
