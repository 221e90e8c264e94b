# A host on a CAN bus: the kernel's virtual one. The unit shuts every network out, and its drop-in opens CAN for one
# instance.
fresh
ip link add vcan0 type vcan
ip link set vcan0 up
mkdir -p /etc/pinion
printf 'board = "sim"\nlink = "can:vcan0,0123456789ab"\n' >/etc/pinion/toolhead.toml
# Without the drop-in the log names it.
mark
not systemctl start pinion-mcu@toolhead
systemctl stop pinion-mcu@toolhead
said pinion-mcu@toolhead | grep 'the CAN interface vcan0 cannot be opened.*install its drop-in for CAN'
install -D -m 644 /usr/share/pinion-mcu/can.conf /etc/systemd/system/pinion-mcu@toolhead.service.d/can.conf
systemctl daemon-reload
fresh
mark
systemctl start pinion-mcu@toolhead
said pinion-mcu@toolhead | grep 'serving on vcan0 (canbus_uuid 0123456789ab)'
is "$(systemctl show -P PrivateNetwork pinion-mcu)" yes "the network of the others"
# As Klipper's canbus_query.py does.
cat >/run/query.py <<'END'
import can
bus = can.interface.Bus(channel="vcan0", interface="socketcan")
bus.send(can.Message(arbitration_id=0x3F0, data=[0], is_extended_id=False))
found = bus.recv(20)
print("%03x %s" % (found.arbitration_id, found.data.hex()))
END
is "$(python3 /run/query.py)" "3f1 200123456789ab01" "the answer to a query"
# No IP address can be reached.
systemctl show -P IPAddressDeny pinion-mcu@toolhead | grep '0.0.0.0/0'
systemctl stop pinion-mcu@toolhead
rm -r /etc/pinion/toolhead.toml /etc/systemd/system/pinion-mcu@toolhead.service.d
systemctl daemon-reload
