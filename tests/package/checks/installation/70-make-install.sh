# Without a package: make install, and make uninstall.
rm -f /etc/pinion/second.toml
dpkg -P pinion-mcu pinion-sim
cp -r /share/tree /root/tree
cd /root/tree
apt-get install -y libiio0 >/dev/null
for prefix in /usr /usr/local; do
    make install PREFIX=$prefix CARGO=true
    systemctl start pinion-mcu
    identifies
    is "$(readlink "/proc/$(pid)/exe")" $prefix/bin/pinion "the program"
    systemctl stop pinion-mcu
    make uninstall PREFIX=$prefix CARGO=true
    [ ! -e /run/pinion ]
    left=$(find / -xdev \( -path /proc -o -path /sys -o -path /share -o -path /var/log -o -path /run -o -path /root \) \
        -prune -o -iname '*pinion*' -print)
    is "$left" "" "what is left"
done
