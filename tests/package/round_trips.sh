# SPDX-License-Identifier: GPL-3.0-or-later
# What klippy says when it homes with an endstop on another MCU, by the round trip to that MCU in ms. The endstop never
# triggers: "No trigger" means that all answers came in time. Run it with --run (docs/develop/test-package.md).
systemctl stop pinion-mcu
mkdir -p /run/trips
cd /run/trips
PINION=/share/pinion HERE=/tmp/klipper_host_here FAR=/tmp/klipper_host_far NEAR=/tmp/klipper_host_near
ask() { /share/host ask /run/trips/api "$@" 2>&1 | head -n 1; }
for trip in none 0 5 10 12 14 15 16 17 20; do
    $PINION run --board sim -r -I $HERE 2>here.log &
    $PINION run --board sim -r -I $FAR 2>far.log &
    sleep 3
    serial=$FAR link=
    if [ $trip != none ]; then
        serial=$NEAR
        # Only the delay counts: the script in the place of ssh waits for no processor.
        chrt --rr 10 $PINION link toolhead --ssh "python3 /share/delayed_ssh.py $PINION $trip 0" -I $NEAR --remote $FAR 2>link.log &
        link=$!
        sleep 5
    fi
    {
        $PINION sim --print-config -I $HERE | sed 's/endstop_pin: x_endstop/endstop_pin: far:x_endstop/'
        printf '\n[mcu far]\nserial: %s\n' $serial
    } >printer.cfg
    rm -f api klippy.log
    python3 /share/klipper/klippy/klippy.py printer.cfg -a /run/trips/api -l klippy.log >/dev/null 2>&1 &
    began=$SECONDS
    until [ "$(ask info '{}' /state)" = ready ] || [ $((SECONDS - began)) -gt 60 ]; do sleep 1; done
    echo "$trip ms: $(ask info '{}' /state) after $((SECONDS - began)) s"
    for _ in 1 2 3 4 5; do echo "    $(ask gcode/script '{ "script": "G28 X" }' '')"; done
    if [ -n "$link" ]; then
        kill -USR1 $link
        sleep 1
        grep 'round trip' link.log | tail -n 1
    fi
    kill $(jobs -p)
    wait
done
