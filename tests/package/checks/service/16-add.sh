# pinion add of the package: on this computer, which is no known board, and on the files of a Raspberry Pi's card with a
# stand-in for Moonraker and klippy.
pinion add | grep 'so its board is not known'
mkdir /run/add
# The pages that its messages name are there.
test -s /usr/share/doc/pinion-mcu/guide/pins.md
not pinion add adxl345 --yes 2>/run/add/refused
grep 'look up in its manual which pins have SPI' /run/add/refused

card=/run/add/card config=/run/add/card/home/klippy/printer_data/config
mkdir -p $card/proc/device-tree $card/boot/firmware $config
printf 'Raspberry Pi 4 Model B Rev 1.4\0' >$card/proc/device-tree/model
# Its last line has no end.
printf 'arm_boost=1\n[all]\nenable_uart=1' >$card/boot/firmware/config.txt
printf '[printer]\nkinematics: corexy\n[stepper_x]\nposition_max: 300\n[stepper_y]\nposition_max: 300\n' >$config/printer.cfg
chmod 640 $config/printer.cfg
chown -R klippy: $card/home/klippy
# All but the records of root's side, whose folder stays as the package's does.
files() {
    find $card -path $card/var -prune -o -printf '%p %M %u %g\n'
    find $card -path $card/var -prune -o -type f -exec sha256sum {} +
}
files | sort >/run/add/before
same() { files | sort | diff "$1" -; }
on_card() { pinion add --root $card "$@"; }

# A host that reads printer.cfg when it restarts, and has an accelerometer if its section is there.
cat >/run/add/moonraker <<'END_OF_PROGRAM'
import glob, http.server, json, os, sys
CONFIG = sys.argv[1]
host = {"state": "standby", "sections": [], "answers": []}

def sections(path):
    for line in open(path):
        # Behind a section may be a comment.
        name = line.split("]")[0].strip("[ \n")
        if line.startswith("[include "):
            for path_ in sorted(glob.glob(os.path.join(os.path.dirname(path), name.split()[1]))):
                yield from sections(path_)
        elif line.startswith("["):
            yield name

class Moonraker(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        status = 200
        if self.path.startswith("/stand-in/"):
            host["state"] = self.path.split("/")[-1]
        if self.path.endswith("/firmware_restart"):
            host["sections"] = list(sections(CONFIG))
        if "ACCELEROMETER_QUERY" in self.path:
            if "adxl345" in host["sections"]:
                values = "// accelerometer values (x, y, z): 120.0, -80.0, 9805.0"
                host["answers"].append({"time": float(len(host["answers"])), "type": "response", "message": values})
            else:
                status = 400
        if "gcode_store" in self.path:
            result = {"gcode_store": host["answers"]}
        elif self.path.endswith("/info"):
            result = {"state": "ready"}
        else:
            result = {"status": {"print_stats": {"state": host["state"]}}, "sections": host["sections"]}
        body = json.dumps({"result": result}).encode()
        self.send_response(status)
        self.end_headers()
        self.wfile.write(body)
    do_POST = do_GET

http.server.HTTPServer(("127.0.0.1", 7126), Moonraker).serve_forever()
END_OF_PROGRAM
python3 /run/add/moonraker $config/printer.cfg 2>/run/add/requests &
trap "kill $!" EXIT
says() { python3 -c 'import sys, urllib.request; print(urllib.request.urlopen("http://127.0.0.1:7126" + sys.argv[1]).read().decode())' "$1"; }
until_true 30 says /

on_card | grep '^This is a Raspberry Pi 4'
on_card adxl345 --dry-run | tee /run/add/shown
grep -x '+ dtparam=spi=on' /run/add/shown
same /run/add/before
# Nothing changes during a print.
says /stand-in/printing
not on_card adxl345 --yes --moonraker 127.0.0.1:7126 2>/run/add/refused
grep 'the host prints' /run/add/refused
same /run/add/before
says /stand-in/standby
on_card adxl345 --yes --moonraker 127.0.0.1:7126 | tee /run/add/added
grep 'it measures 120, -80, 9805 mm/s2: 1.00 of gravity' /run/add/added
grep -x 'dtparam=spi=on' $card/boot/firmware/config.txt
is "$(stat -c '%U %a' $config/printer.cfg)" "klippy 640" printer.cfg
is "$(stat -c %U $config/pinion/adxl345.cfg)" klippy "the device's file"
files | sort >/run/add/after
grep -c firmware_restart /run/add/requests >/run/add/restarts
on_card adxl345 --yes --moonraker 127.0.0.1:7126 | grep 'Nothing is left to change'
same /run/add/after
is "$(grep -c firmware_restart /run/add/requests)" "$(cat /run/add/restarts)" "the number of restarts"
on_card adxl345 --undo --yes --moonraker 127.0.0.1:7126 | grep 'The host has restarted without the device'
same /run/add/before
says / | not grep adxl345
rm -r /run/add
