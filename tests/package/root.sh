#!/bin/sh
# SPDX-License-Identifier: GPL-3.0-or-later
# Makes the VM that the package is installed in: a Debian 12 with systemd.
#
#   root.sh FOLDER TREE INITRAMFS RELEASE HERE SOURCES
#
# FOLDER gets root.img and initrd. TREE and INITRAMFS are of tests/support/testkit: parts of Debian's kernel package, and
# the modules that it has built. HERE is the folder of this file. SOURCES is a sources.list of Debian 12.
set -eu
cd "$1"
tree=$2 initramfs=$3 release=$4 here=$5 sources=$6
busybox=$tree/bin/busybox
# The computer's PATH may mean nothing there.
in_root() { chroot root /usr/bin/env PATH=/usr/sbin:/usr/bin:/sbin:/bin "$@"; }

# Pinion's dependencies wait in a folder of the VM, and its apt installs from there: the VM has no network. Only libiio
# itself waits there. It needs ICU (by way of libxml2), and the emulated processor takes half a minute to install that.
# The packages of Python are klippy's. sshd is for the link over SSH.
mmdebstrap --quiet --mode=root --variant=minbase \
    --include=sudo,apt-utils \
    --include=systemd,systemd-sysv,udev,dbus,kmod,procps,make,libiio0- \
    --include=libavahi-client3,libserialport0,libusb-1.0-0,libxml2 \
    --include=iproute2,python3-can,python3-cffi,python3-greenlet,python3-jinja2,python3-serial \
    --include=openssh-server \
    --dpkgopt=force-unsafe-io --dpkgopt='path-exclude=/usr/share/locale/*' --dpkgopt='path-exclude=/usr/share/doc/*' \
    --dpkgopt='path-include=/usr/share/doc/pinion-mcu/*' --dpkgopt='path-exclude=/var/lib/dpkg/available' \
    --customize-hook='chroot "$1" apt-get clean' \
    --customize-hook='chroot "$1" apt-get -qq install -d -y --no-install-recommends libiio0' \
    --customize-hook='mkdir "$1/opt/packages" && mv "$1"/var/cache/apt/archives/*.deb "$1/opt/packages"' \
    --customize-hook='cd "$1/opt/packages" && dpkg-scanpackages -m . >Packages 2>/dev/null' \
    --customize-hook='rm -rf "$1"/etc/apt/sources.list*' \
    bookworm root "$sources"
echo 'deb [trusted=yes] file:/opt/packages ./' >root/etc/apt/sources.list
# apt would look for questions in each package, with Perl. No package here has any.
rm root/etc/apt/apt.conf.d/70debconf
# klippy's user, who is in the group that the README names, and somebody else.
in_root useradd -m -s /bin/bash -G tty klippy
in_root useradd -m -s /bin/bash stranger
echo guest >root/etc/hostname
# Its check starts it.
in_root systemctl --quiet disable ssh
mkdir -p root/var/log/journal

modules=root/usr/lib/modules/$release
mkdir -p root/usr/lib/modules unpacked
cp -r "$tree/lib/modules/$release" "$modules"
mkdir -p "$modules/updates"
(cd unpacked && "$busybox" cpio -idm <"$initramfs" 2>/dev/null)
for module in gpio-sim irq_sim mock_adc mock_pwm mock_spi mock_i2c mock_w1; do
    cp "unpacked/tests/modules.d/$module.ko" "$modules/updates/"
done
: >"$modules/modules.order"
in_root depmod "$release"

install -m 755 "$here/guest/agent" "$here/guest/chips" root/usr/local/sbin/
install -m 644 "$here"/guest/*.service root/etc/systemd/system/
mkdir -p root/etc/systemd/system/multi-user.target.wants
for unit in "$here"/guest/*.service; do
    in_root systemctl --quiet enable "$(basename "$unit")"
done
printf 'virtio_console\nconfigfs\n9pnet_virtio\n' >root/etc/modules-load.d/tests.conf
# It has no console that anybody logs in at, and nothing to tidy up. systemd reads all units at each daemon-reload,
# which takes the emulated processor long. So units that no check and no page needs are removed.
(cd root/usr/lib/systemd/system && rm -rf *getty* apt-daily* dpkg-db-backup* e2scrub* fstrim* emergency* initrd* \
    remote-* rescue* *binfmt* *cryptsetup* *integritysetup* *veritysetup* systemd-ask-password* systemd-firstboot* \
    systemd-fsck* systemd-initctl* systemd-pcrphase* systemd-pstore* systemd-repart* systemd-sysext* \
    systemd-udev-settle* systemd-update-utmp*)
# It also starts these programs then. Nothing that they generate is needed.
mkdir root/etc/systemd/system-generators
for generator in root/usr/lib/systemd/system-generators/*; do
    ln -s /dev/null "root/etc/systemd/system-generators/${generator##*/}"
done
truncate -s 1200M root.img
mke2fs -q -t ext4 -O '^metadata_csum,^has_journal' -d root root.img

# An initrd that finds the disk.
mkdir -p first/bin first/modules first/dev first/proc first/root
cp "$busybox" first/bin/busybox
for module in virtio_pci virtio_blk ext4 crc32c_generic; do
    in_root modprobe -S "$release" --show-depends "$module"
done | awk '/^insmod/ && !seen[$2]++ { print $2 }' >loads
while read -r module; do
    cp "root$module" first/modules/
    echo "/modules/${module##*/}" >>first/list
done <loads
cat >first/init <<'END'
#!/bin/busybox sh
/bin/busybox --install -s /bin
mount -t devtmpfs devtmpfs /dev
while read -r module; do insmod "$module"; done </list
mount -t ext4 -o rw /dev/vda /root && mount --move /dev /root/dev && exec switch_root /root /sbin/init
END
chmod 755 first/init
(cd first && find . | "$busybox" cpio -o -H newc 2>/dev/null) >initrd
rm -rf root unpacked first loads
