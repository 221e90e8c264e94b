# The apt repository of a release: added by its four lines, installed, and upgraded while the service serves: a running
# print and edited files are kept, and no question is asked. A restart then runs the new unit. A file of the repository
# that somebody has changed is refused.
systemctl is-system-running --wait || true
until_true 30 is_active test-chips
export DEBIAN_FRONTEND=noninteractive
APT=/srv/pinion-apt
# serve FOLDER: the repository's files are now these.
serve() { rm -rf $APT && cp -r "$1" $APT; }
update() { apt-get update </dev/null 2>&1 | tee /run/apt && not grep '^[WE]:' /run/apt; }
# refused WORDS COMMAND...: the command fails with these words.
refused() {
    not "${@:2}" </dev/null >/run/apt 2>&1
    grep -E "$1" /run/apt
}
version() { dpkg-query -W -f '${Version}' pinion-mcu; }

serve /share/apt
is "$(wc -l <$APT/pinion.sources)" 4 "the number of lines"
grep -q '^Signed-By: /etc/apt/keyrings/pinion.asc$' $APT/pinion.sources
mkdir -p /etc/apt/sources.list.d
install -D -m 644 $APT/pinion.asc /etc/apt/keyrings/pinion.asc
install -m 644 $APT/pinion.sources /etc/apt/sources.list.d/
update
apt-get install -y --no-install-recommends pinion-mcu </dev/null
is "$(version)" "$(dpkg-deb -f /share/pinion-mcu.deb Version)" "the version"

# A print goes on with the old program.
light
before=$(pid)
doctor | not grep 'a restart is due'
echo 'PINION_OPTIONS="--log-level debug"' >/etc/default/pinion-mcu
serve /share/apt-next
update
apt-get upgrade -y </dev/null 2>&1 | tee /run/upgrade
grep -q 'Pinion still runs as it was' /run/upgrade
is "$(version)" "$(dpkg-deb -f /share/later.deb Version)" "the version"
is "$(pid)" "$before" "the process"
is "$(systemctl show -P NeedDaemonReload pinion-mcu)" no NeedDaemonReload
grep -q 'log-level debug' /etc/default/pinion-mcu
# The file was as the former package had delivered it, so it was replaced.
grep -q '^# of the later package' /etc/pinion/pinion.toml
# The same host still refreshes the heater.
sleep 4
is_high 3
doctor | grep -A 2 'a restart is due' | grep 'systemctl restart pinion-mcu'
dark
systemctl restart pinion-mcu
is "$(systemctl show -P Description pinion-mcu)" 'The later unit' "the unit"
identifies
doctor | not grep 'a restart is due'
rm /etc/default/pinion-mcu

# A package, a list, and a list with its own checksum in Release.
printf x >>$APT/later.deb
apt-get clean
refused 'unexpected size|Hash Sum mismatch' apt-get install -y --reinstall pinion-mcu
serve /share/apt-next
sed -i 's/^Depends: /&evil, /' $APT/Packages
gzip -9 -n -k -f $APT/Packages
rm -r /var/lib/apt/lists/*pinion*
refused 'unexpected size|Hash Sum mismatch' apt-get update -o APT::Update::Error-Mode=any
for list in Packages Packages.gz; do
    sed -i "s/^ [0-9a-f]* [0-9]* $list$/ $(sha256sum $APT/$list | cut -d ' ' -f 1) $(stat -c %s $APT/$list) $list/" $APT/InRelease
done
refused 'invalid|BADSIG' apt-get update -o APT::Update::Error-Mode=any
# Without the signature.
cp $APT/Release /run/Release
rm $APT/InRelease
refused 'not signed|no longer signed' apt-get update -o APT::Update::Error-Mode=any

rm -r /etc/apt/sources.list.d/pinion.sources /etc/apt/keyrings/pinion.asc $APT
apt-get -qq update
# The next checks need another instance, whose configuration is its owner's.
: >/etc/pinion/second.toml
systemctl enable --now pinion-mcu@second
