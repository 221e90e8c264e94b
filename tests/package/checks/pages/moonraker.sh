# later N: adds a later package with another configuration file to apt's folder.
later() {
    rm -rf /run/later
    dpkg-deb -R /share/later.deb /run/later
    sed -i "s/^Version: .*/&$1/" /run/later/DEBIAN/control
    echo "# of package $1" >>/run/later/usr/share/pinion-mcu/pinion.toml
    dpkg-deb --root-owner-group -Znone -b /run/later "/srv/pinion/pinion-mcu_later$1.deb"
    (cd /srv/pinion && apt-ftparchive packages . >Packages)
    apt-get -qq update
}
version() { dpkg-query -W -f '${Version}' pinion-mcu; }

installed
install -d -o pi /home/pi/printer_data /srv/pinion
# Moonraker's own file has a newline at its end. A user's edit may have removed it.
printf 'klipper_mcu\nwebcamd' >/home/pi/printer_data/moonraker.asvc
chown pi: /home/pi/printer_data/moonraker.asvc
echo 'deb [trusted=yes] file:/srv/pinion ./' >/etc/apt/sources.list.d/pinion.list
later 1
page docs/guide/moonraker.md
is "$(cat /home/pi/printer_data/moonraker.asvc)" "$(printf 'klipper_mcu\nwebcamd\npinion-mcu')" "Moonraker's services"
# Before Moonraker's first start there is no file, and none is made: it would lack Moonraker's entries.
mkdir -p /run/fresh
not sed -i '$a pinion-mcu' /run/fresh/moonraker.asvc
[ ! -e /run/fresh/moonraker.asvc ]
case $(version) in *later1) ;; *) fail "the version is $(version)" ;; esac

# A changed configuration, and no answers to questions.
echo '# edited' >>/etc/pinion/pinion.toml
later 2
DEBIAN_FRONTEND=noninteractive apt-get upgrade --yes </dev/null
case $(version) in *later2) ;; *) fail "the version is $(version)" ;; esac
grep '^# edited' /etc/pinion/pinion.toml
rm -r /etc/apt/sources.list.d/pinion.list /srv/pinion
apt-get -qq update
