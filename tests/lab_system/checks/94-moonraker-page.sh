# later N: the folder that apt takes packages from has a later one, whose configuration file is another.
later() {
    rm -rf /run/later
    dpkg-deb -R /share/later.deb /run/later
    sed -i "s/^Version: .*/&$1/" /run/later/DEBIAN/control
    echo "# of package $1" >>/run/later/etc/default/pinion-mcu
    dpkg-deb --root-owner-group -Znone -b /run/later "/srv/pinion/pinion-mcu_later$1.deb"
    (cd /srv/pinion && apt-ftparchive packages . >Packages)
    apt-get -qq update
}
version() { dpkg-query -W -f '${Version}' pinion-mcu; }

installed
install -d -o pi /home/pi/printer_data /srv/pinion
# Moonraker's own has an end of its last line; who has edited it may have taken that away.
printf 'klipper_mcu\nwebcamd' >/home/pi/printer_data/moonraker.asvc
chown pi: /home/pi/printer_data/moonraker.asvc
echo 'deb [trusted=yes] file:/srv/pinion ./' >/etc/apt/sources.list.d/pinion.list
later 1
page docs/moonraker.md
grep -x pinion-mcu /home/pi/printer_data/moonraker.asvc
grep -x webcamd /home/pi/printer_data/moonraker.asvc
case $(version) in *later1) ;; *) fail "the version is $(version)" ;; esac

# A changed configuration file, and nobody to answer: it fails as the page says, but not with what that tells to write.
echo '# edited' >>/etc/default/pinion-mcu
later 2
mv /etc/apt/apt.conf.d/90keep-configuration /run/keep
not apt-get upgrade --yes </dev/null >/run/upgrade 2>&1
grep 'end of file on stdin at conffile prompt' /run/upgrade
dpkg --configure -a <$ENTERS
grep '^# edited' /etc/default/pinion-mcu
later 3
mv /run/keep /etc/apt/apt.conf.d/90keep-configuration
apt-get upgrade --yes </dev/null
case $(version) in *later3) ;; *) fail "the version is $(version)" ;; esac
grep '^# edited' /etc/default/pinion-mcu
rm -r /etc/apt/apt.conf.d/90keep-configuration /etc/apt/sources.list.d/pinion.list /srv/pinion
apt-get -qq update
