# Pinion in a container, and its host in another one: docs/guide/container.md.
systemctl stop pinion-mcu
rm -f $LINK
podman load -q -i /share/image/pinion-image-amd64.tar
is "$(podman image inspect -f '{{.Architecture}} {{.Os}}' localhost/pinion)" 'amd64 linux' "the image"
podman volume create --opt type=devpts --opt device=devpts --opt o=gid=5,mode=620,ptmxmode=666 pinion-pts
podman volume create pinion-tmp
pinion_container() {
    podman run -d --name pinion --network none --cap-drop all --security-opt no-new-privileges \
        --ulimit rtprio=99 --ulimit memlock=-1 -v pinion-pts:/dev/pts:dev -v pinion-tmp:/tmp \
        --device /dev/gpiochip0 --group-add "$(stat -c %g /dev/gpiochip0)" "$@"
}
# The host's container: klippy's user, and no device.
host_container() {
    podman run --rm --network none --user "$(id -u klippy)" --group-add 5 -v pinion-pts:/dev/pts:dev \
        -v pinion-tmp:/tmp -v /share:/share:ro --entrypoint /share/host "$@"
}
has_link() { [ -L "$(podman volume inspect -f '{{.Mountpoint}}' pinion-tmp)/klipper_host_mcu" ]; }
said_pinion() { podman logs pinion 2>&1; }

pinion_container --pid host localhost/pinion
until_true 30 has_link
host_container localhost/pinion identify $LINK HEATER
host_container --name light localhost/pinion light $LINK HEATER >/run/light 2>&1 &
until_true 60 grep -q lit /run/light
until_true 5 is_high 3
podman run --rm --network none -v pinion-tmp:/tmp localhost/pinion status
said_pinion
said_pinion | not grep -i -E 'real time.*(not|without)|pid=host'
# It sees no other device.
said_pinion | grep 'board linux' | not grep spidev
# The guardian outlives the program.
kill -9 "$(podman inspect -f '{{.State.Pid}}' pinion)"
until_true 5 is_low 3
podman rm -f light pinion
wait

# With process numbers of its own, it says what is missing.
pinion_container localhost/pinion
until_true 30 has_link
until_true 10 eval 'said_pinion | grep -e --pid=host'
# A stop sets the outputs.
host_container --name light localhost/pinion light $LINK HEATER >/run/light 2>&1 &
until_true 60 grep -q lit /run/light
until_true 5 is_high 3
podman stop pinion
is_low 3
podman rm -f light pinion
wait
podman volume rm pinion-pts pinion-tmp
podman image rm localhost/pinion
systemctl start pinion-mcu
