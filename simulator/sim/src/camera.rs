// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim --camera`: the simulated printer as a webcam.

use std::fs;
use std::io::ErrorKind;
use std::net::{SocketAddr, TcpListener, ToSocketAddrs};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use pinion_camera::scene::{
    Axis, Bed, Display, Fan, Gantry, Heater, Laid, Lamp, Pin, Printer, Probe, Rgb, Scene, Servo, Strip,
};
use pinion_camera::{Layout, Limits, Picture};
use pinion_firmware::time::CLOCK_FREQ;
use pinion_firmware::trouble::Trouble;
use pinion_linux::{LOOK_AT_LOG, sys};
use pinion_model::{BedShape, Colour, Look, PartConfig, PathPoint, Recorder, SimConfig, SimProbe, Space};

use crate::own_status::OwnStatus;
use targets::Targets;

mod targets;

/// Where the camera is served by default.
pub(crate) const ADDRESS: &str = "127.0.0.1:8410";
/// The camera waits for everything else on this computer.
const NICE: i32 = 10;
/// Time between two reads of the steps: the printer keeps half a second of them.
const READ_PERIOD: Duration = Duration::from_millis(100);
/// A print begins after a pause of this time, with a piece that is lower than the last one by this much.
const PAUSE_S: f64 = 20.0;
const LAYER_MM: f64 = 0.05;
/// Steps may be uneven for this time.
const JERK_S: f64 = 0.05;
/// Points of a path that are kept during a pause: what is drawn needs none.
const POINTS: usize = 10_000;
/// Longest part of an axis that a picture shows.
const LONGEST_MM: f64 = 1000.0;
/// The axis of the second carriage of an IDEX printer.
const SECOND_CARRIAGE: &str = "dual_carriage";
/// The color of a light that has only one.
const WARM_WHITE: Rgb = [255, 240, 205];
/// The picture's extent for a printer without a bed.
const NO_BED: Space = Space { bed: BedShape::Rectangle { min_mm: [0.0; 2], max_mm: [200.0; 2] }, height_mm: 200.0 };

/// An address as `--camera` takes it.
pub(crate) fn parse(text: &str) -> Result<String, String> {
    match text.rsplit_once(':') {
        Some((host, port)) if !host.is_empty() && port.parse::<u16>().is_ok() => Ok(text.to_owned()),
        _ => Err(format!("give ADDR:PORT, such as {ADDRESS}; a FILE.toml comes before --camera")),
    }
}

/// Facts about a printer that never change.
struct Subject {
    gantry: Gantry,
    probes: Vec<Probe>,
    /// The axes that find their ends by stalling. They lose steps there on purpose.
    stalling: Vec<String>,
}

impl Subject {
    fn new(config: &SimConfig) -> Subject {
        let gantry = match &config.delta {
            Some(delta) => Gantry::Delta { towers_mm: delta.towers_mm(), arm_mm: delta.arm_mm },
            None if config.corexy => Gantry::CoreXy,
            None => Gantry::Cartesian,
        };
        let stalling = config.parts.iter().filter_map(stalling).map(str::to_owned).collect();
        Subject { gantry, probes: config.parts.iter().filter_map(probe).collect(), stalling }
    }
}

fn printer(gantry: Gantry, sim: &SimProbe) -> Printer {
    let Space { bed, height_mm } = sim.space().unwrap_or(NO_BED);
    Printer { bed: shape(bed), height_mm: height_mm.min(LONGEST_MM), gantry }
}

/// A JPEG of the printer now, with the filament that this recorder saw. `None` without memory for it.
pub(crate) fn picture(config: &SimConfig, sim: &SimProbe, recorder: Recorder) -> Option<Vec<u8>> {
    let Subject { gantry, probes, stalling } = Subject::new(config);
    let laid = Arc::new(Mutex::new(Vec::new()));
    Filament { recorder, ..Filament::new(sim.clone(), laid.clone()) }.read();
    let laid = std::mem::take(&mut *laid.lock().unwrap_or_else(PoisonError::into_inner));
    let mut picture = Picture::new(printer(gantry, sim))?;
    let mut scene = Scene { laid, ..scene(sim, &probes, &Targets::default()) };
    // Nobody knows by now which of their steps were lost in a print.
    for axis in scene.axes.iter_mut().filter(|axis| stalling.contains(&axis.name)) {
        axis.lost_steps = 0;
    }
    picture.take(&scene);
    picture.draw(&scene, Layout::Wide);
    Some(picture.jpeg(Layout::Wide))
}

/// A camera that nobody can look through yet.
pub(crate) struct Camera {
    listener: TcpListener,
    subject: Subject,
}

impl Camera {
    /// Takes the address, and what never changes about the printer.
    pub(crate) fn open(address: &str, config: &SimConfig) -> Result<Camera, Trouble> {
        let listener = bind(address).map_err(|trouble| trouble.of(format_args!("--camera {address}")))?;
        Ok(Camera { listener, subject: Subject::new(config) })
    }

    /// Serves the picture from now on, and says where. Call it before this thread runs in real time: the camera's
    /// threads get its scheduling.
    pub(crate) fn start(self, sim: SimProbe, own: OwnStatus) -> Result<(), Trouble> {
        let Camera { listener, subject: Subject { gantry, probes, stalling } } = self;
        let printer = printer(gantry, &sim);
        let address = listener.local_addr().map_err(|error| Trouble::new(error.to_string()).of("--camera"))?;
        let thread = thread::Builder::new().name("camera".into()).spawn(move || {
            if let Err(error) = sys::set_nice(NICE) {
                log::debug!("the camera's nice value: {error}");
            }
            let laid = Arc::new(Mutex::new(Vec::new()));
            let mut filament = Filament::new(sim.clone(), laid.clone());
            let heaters = sim.heaters().map(|heater| heater.name.to_owned()).collect();
            let targets = Targets::start(own.clone(), heaters).unwrap_or_else(|error| {
                log::warn!("the camera shows no targets of heaters: {error}: raise ulimit -u, and start again");
                Targets::default()
            });
            let start = Instant::now();
            let mut losses = Losses { stalling, ..Losses::default() };
            let look = move || {
                let laid = std::mem::take(&mut *laid.lock().unwrap_or_else(PoisonError::into_inner));
                let (seconds, is_shut_down) = (start.elapsed().as_secs_f64(), own.stop().is_some());
                let mut scene = Scene { seconds, is_shut_down, laid, ..scene(&sim, &probes, &targets) };
                losses.keep_of_print(&mut scene);
                scene
            };
            let thread = thread::Builder::new().name("camera path".into()).spawn(move || {
                loop {
                    filament.read();
                    thread::sleep(READ_PERIOD);
                }
            });
            let Err(error) = thread.and_then(|_| pinion_camera::serve(&listener, printer, Limits::default(), look));
            log::error!("the camera shows nothing: {error}: free memory, or raise ulimit -u, and start again");
        });
        pinion_runtime::started(thread)?;
        let url = url(address);
        log::info!("camera: {url}/ in a browser, {url}/stream and {url}/snapshot in Mainsail or Fluidd");
        Ok(())
    }
}

/// The filament that the nozzle lays. The printer keeps the last steps only, so somebody has to read them even while
/// nobody looks.
struct Filament {
    sim: SimProbe,
    recorder: Recorder,
    /// The number of points that were read.
    read: usize,
    /// The last point where filament was laid.
    last: Option<PathPoint>,
    /// The speed there.
    mm_per_s: f64,
    /// Pieces that are not drawn yet.
    laid: Arc<Mutex<Vec<Laid>>>,
}

impl Filament {
    fn new(sim: SimProbe, laid: Arc<Mutex<Vec<Laid>>>) -> Filament {
        Filament { recorder: sim.recorder(), sim, read: 1, last: None, mm_per_s: 0.0, laid }
    }

    fn read(&mut self) {
        let now = self.sim.now();
        self.recorder.read(now);
        let points = self.recorder.points();
        let mut new = Vec::new();
        for pair in points[self.read - 1..].windows(2) {
            let (from, to) = (pair[0], pair[1]);
            if to.laid_mm <= 0.0 || to.is_start {
                continue;
            }
            let begins = self.last.is_none_or(|last| {
                let pause_s = to.at.since(last.at) as f64 / CLOCK_FREQ as f64;
                pause_s > PAUSE_S && to.nozzle_mm[2] < last.nozzle_mm[2] - LAYER_MM
            });
            if begins {
                new.clear();
            }
            let is_joined = self.last.is_some_and(|last| from.at.since(last.at) == 0);
            self.mm_per_s = speed(&from, &to, is_joined.then_some(self.mm_per_s));
            let [from_mm, to_mm] = [from, to].map(|point| point.nozzle_mm.map(|mm| mm as f32));
            new.push(Laid { from_mm, to_mm, mm_per_s: self.mm_per_s as f32, begins });
            self.last = Some(to);
        }
        self.read = points.len();
        let is_calm = points.last().is_none_or(|last| now.since(last.at) as f64 > PAUSE_S * CLOCK_FREQ as f64);
        if self.recorder.is_full() || (is_calm && self.read > POINTS) {
            (self.recorder, self.read) = (self.sim.recorder(), 1);
        }
        let mut laid = self.laid.lock().unwrap_or_else(PoisonError::into_inner);
        if new.first().is_some_and(|piece| piece.begins) {
            laid.clear();
        }
        laid.append(&mut new);
    }
}

/// The speed from one point to the next, in mm/s. `before` is the speed up to the first one, if the line was the same.
/// Short pieces count little: the steps of a busy computer come in jerks, which a part does not show.
fn speed(from: &PathPoint, to: &PathPoint, before: Option<f64>) -> f64 {
    let mm = |axis: usize| to.nozzle_mm[axis] - from.nozzle_mm[axis];
    let length_mm = (mm(0) * mm(0) + mm(1) * mm(1) + mm(2) * mm(2)).sqrt();
    let seconds = to.at.since(from.at) as f64 / CLOCK_FREQ as f64;
    let now = length_mm / seconds;
    before.map_or(now, |before| before + (now - before) * (seconds / JERK_S).min(1.0))
}

/// How a browser gets to the camera.
fn url(address: SocketAddr) -> String {
    match fs::read_to_string("/proc/sys/kernel/hostname") {
        Ok(name) if address.ip().to_canonical().is_unspecified() => {
            format!("http://{}:{}", name.trim(), address.port())
        }
        _ => format!("http://{address}"),
    }
}

fn bind(address: &str) -> Result<TcpListener, Trouble> {
    let unknown = |cause: String| {
        Trouble::new(format!("the name has no address: {cause}"))
            .remedy("use an IP address, such as 127.0.0.1 or 0.0.0.0")
    };
    let addresses = address.to_socket_addrs().map_err(|error| unknown(error.to_string()))?;
    let mut refused = unknown("it is unknown".into());
    for address in addresses {
        match TcpListener::bind(address) {
            Ok(listener) => return Ok(listener),
            Err(error) => refused = refusal(&error),
        }
    }
    Err(refused)
}

fn refusal(error: &std::io::Error) -> Trouble {
    let (cause, remedy) = match error.kind() {
        ErrorKind::AddrInUse => {
            ("another program uses the port".to_owned(), "choose another port, or end that program (ss -ltnp)")
        }
        ErrorKind::AddrNotAvailable => (
            "this computer does not have the address".to_owned(),
            "use one that `ip address` lists, or 0.0.0.0 for all of them",
        ),
        ErrorKind::PermissionDenied => (format!("the port is not for everybody: {error}"), "choose a port above 1023"),
        _ => (error.to_string(), LOOK_AT_LOG),
    };
    Trouble::new(cause).remedy(remedy)
}

/// The steps that axes with sensorless homing lose while something is printed. What they lose at their ends is no fault.
#[derive(Default)]
struct Losses {
    stalling: Vec<String>,
    /// The steps of each that were lost before the print.
    before: Vec<u64>,
    /// When something was laid last.
    laid_at: Option<f64>,
}

impl Losses {
    fn keep_of_print(&mut self, scene: &mut Scene) {
        if !scene.laid.is_empty() {
            self.laid_at = Some(scene.seconds);
        }
        let is_printing = self.laid_at.is_some_and(|at| scene.seconds - at <= PAUSE_S);
        self.before.resize(self.stalling.len(), 0);
        for (name, before) in self.stalling.iter().zip(&mut self.before) {
            let Some(axis) = scene.axes.iter_mut().find(|axis| axis.name == *name) else { continue };
            if !is_printing {
                *before = axis.lost_steps;
            }
            axis.lost_steps = axis.lost_steps.saturating_sub(*before);
        }
    }
}

/// The axis whose driver reports a stall. `None` for another part.
fn stalling(part: &PartConfig) -> Option<&str> {
    let (axis, reports) = match part {
        PartConfig::Tmc2209(driver) => (&driver.axis, driver.diag_pin.is_some()),
        PartConfig::Tmc2130(driver) => (&driver.axis, driver.diag0_pin.is_some() || driver.diag1_pin.is_some()),
        PartConfig::Tmc2240(driver) => (&driver.axis, driver.diag0_pin.is_some() || driver.diag1_pin.is_some()),
        PartConfig::Tmc2240Uart(driver) => (&driver.axis, driver.diag0_pin.is_some() || driver.diag1_pin.is_some()),
        PartConfig::Tmc5160(driver) => (&driver.axis, driver.diag0_pin.is_some() || driver.diag1_pin.is_some()),
        _ => return None,
    };
    reports.then_some(axis)
}

/// The end of an axis in the picture. That of a belt may be kilometers away.
fn near(from_mm: f64, to_mm: f64) -> [f64; 2] {
    [from_mm, to_mm.min(from_mm + LONGEST_MM)]
}

fn shape(bed: BedShape) -> Bed {
    match bed {
        BedShape::Rectangle { min_mm: [x0, y0], max_mm: [x1, y1] } => {
            Bed::Rectangle { x_mm: near(x0, x1), y_mm: near(y0, y1) }
        }
        BedShape::Disc { radius_mm } => Bed::Disc { radius_mm },
    }
}

/// A probe with its tip. `None` for another part.
fn probe(part: &PartConfig) -> Option<Probe> {
    let (name, x, y, z) = match part {
        PartConfig::Probe(probe) => ("probe", probe.x_offset_mm, probe.y_offset_mm, probe.z_offset_mm),
        PartConfig::Bltouch(probe) => ("bltouch", probe.x_offset_mm, probe.y_offset_mm, probe.z_offset_mm),
        _ => return None,
    };
    Some(Probe { name: name.into(), offset_mm: [x, y, -z], pin: None })
}

/// The printer now.
fn scene(sim: &SimProbe, probes: &[Probe], targets: &Targets) -> Scene {
    let mut scene = Scene { nozzle_mm: sim.nozzle_mm(), probes: probes.to_vec(), ..Scene::default() };
    for axis in sim.axes() {
        let (name, position_mm, lost_steps) = (axis.name.into(), axis.position_mm, axis.lost_steps);
        scene.axes.push(Axis { name, position_mm, lost_steps });
    }
    scene.parked_mm.extend(parked(&scene));
    for heater in sim.heaters() {
        let (name, target_celsius) = (heater.name.into(), targets.of(heater.name));
        scene.heaters.push(Heater { name, celsius: heater.celsius, target_celsius, on: heater.on });
    }
    scene.fans.extend(sim.fans().map(|fan| Fan { name: fan.name.into(), rpm: fan.rpm }));
    for output in sim.outputs() {
        let (name, brightness) = (output.name.into(), output.brightness);
        scene.lamps.push(Lamp { name, brightness, color: WARM_WHITE });
    }
    for (name, look) in sim.sights() {
        show(&mut scene, name, look);
    }
    scene
}

/// The nozzle of the carriage of an IDEX printer that does not print: the nozzle's place is that of the other one.
fn parked(scene: &Scene) -> Option<[f64; 3]> {
    let position = |name: &str| scene.axes.iter().find(|axis| axis.name == name).map(|axis| axis.position_mm);
    let (first, second) = (position("x")?, position(SECOND_CARRIAGE)?);
    let [x, y, z] = scene.nozzle_mm;
    let is_second = (x - second).abs() < (x - first).abs();
    Some([if is_second { first } else { second }, y, z])
}

/// Adds what a part looks like.
fn show(scene: &mut Scene, part: &str, look: Look) {
    let name = part.to_owned();
    match look {
        Look::Lights { colours, .. } => match &colours[..] {
            // Its brightness is that of its brightest part.
            [light] => {
                let shown = rgb(*light);
                let most = shown.into_iter().max().unwrap_or(0);
                let color =
                    shown.map(|part| if most == 0 { 0 } else { (u32::from(part) * 255 / u32::from(most)) as u8 });
                scene.lamps.push(Lamp { name, brightness: f64::from(most) / 255.0, color });
            }
            _ => scene.strips.push(Strip { name, lights: colours.into_iter().map(rgb).collect() }),
        },
        Look::Pixels { width, is_on, lit, .. } => {
            let pixels = lit.into_iter().map(|is_lit| is_lit && is_on).collect();
            scene.displays.push(Display { name, width, pixels });
        }
        Look::Angle { degrees } => scene.servos.push(Servo { name, degrees }),
        Look::Pin { is_down, alarm } => {
            let pin = match (alarm, is_down) {
                (true, _) => Pin::Alarm,
                (false, true) => Pin::Out,
                (false, false) => Pin::In,
            };
            if let Some(probe) = scene.probes.iter_mut().find(|probe| probe.name == part) {
                probe.pin = Some(pin);
            }
        }
        Look::Power { share } => scene.lamps.push(Lamp { name, brightness: share, color: WARM_WHITE }),
    }
}

/// The color that an eye sees: the white part adds to all others.
fn rgb(Colour { red, green, blue, white }: Colour) -> Rgb {
    [red, green, blue].map(|part| part.saturating_add(white))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn axis(name: &str, position_mm: f64, lost_steps: u64) -> Axis {
        Axis { name: name.into(), position_mm, lost_steps }
    }

    #[test]
    fn a_belt_of_kilometers_has_a_picture() {
        let belt = BedShape::Rectangle { min_mm: [0.0, -5.0], max_mm: [200.0, 20_000_000.0] };
        assert_eq!(shape(belt), Bed::Rectangle { x_mm: [0.0, 200.0], y_mm: [-5.0, 995.0] });
    }

    #[test]
    fn the_carriage_that_does_not_print_is_parked() {
        let scene = |x: f64| {
            let axes = vec![axis("x", -10.0, 0), axis("dual_carriage", 250.0, 0)];
            Scene { nozzle_mm: [x, 5.0, 1.0], axes, ..Scene::default() }
        };
        assert_eq!(parked(&scene(-10.0)), Some([250.0, 5.0, 1.0]));
        assert_eq!(parked(&scene(250.0)), Some([-10.0, 5.0, 1.0]));
        assert_eq!(parked(&Scene { axes: vec![axis("x", 1.0, 0)], ..Scene::default() }), None);
    }

    #[test]
    fn steps_that_sensorless_homing_loses_are_no_fault() {
        let mut losses = Losses { stalling: vec!["x".into()], ..Losses::default() };
        let mut shown = |seconds: f64, lost: u64, prints: bool| {
            let piece = Laid { from_mm: [0.0; 3], to_mm: [1.0; 3], mm_per_s: 1.0, begins: false };
            let laid = if prints { vec![piece] } else { Vec::new() };
            let mut scene =
                Scene { seconds, laid, axes: vec![axis("x", 0.0, lost), axis("y", 0.0, lost)], ..Scene::default() };
            losses.keep_of_print(&mut scene);
            [scene.axes[0].lost_steps, scene.axes[1].lost_steps]
        };
        assert_eq!(shown(1.0, 40, false), [0, 40], "y has an endstop");
        assert_eq!(shown(30.0, 40, true), [0, 40]);
        assert_eq!(shown(31.0, 47, true), [7, 47], "in a print");
        assert_eq!(shown(32.0, 47, false), [7, 47]);
        assert_eq!(shown(99.0, 90, false), [0, 90], "homed again");
    }
}
