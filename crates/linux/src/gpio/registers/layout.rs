// SPDX-License-Identifier: GPL-3.0-or-later
//! The arrangement of the registers of each known chip.

#![forbid(unsafe_code)]

use super::line::{Field, LineRegisters, Register, RegisterBank};

/// The arrangement of a chip's registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Layout {
    /// BCM2835 to BCM2711, in every Raspberry Pi before the 5: "BCM2835 ARM Peripherals", section 6.1, and
    /// drivers/pinctrl/bcm/pinctrl-bcm2835.c (GPFSEL0, GPSET0, GPCLR0, GPLEV0). Each line has 3 bits in a function
    /// select register of ten lines. The other registers have 32 lines each.
    Bcm2835,
    /// RP1, in the Raspberry Pi 5: "RP1 Peripherals", section 3.1, and drivers/pinctrl/pinctrl-rp1.c of the Raspberry
    /// Pi's kernel (`rp1_iobanks`, RP1_GPIO_CTRL, RP1_RIO_*, RP1_SET_OFFSET, RP1_CLR_OFFSET). Its gpiomem0 is io_bank,
    /// sys_rio and pads, one after the other.
    Rp1,
}

impl Layout {
    /// The layout of a chip with this `compatible` property of the device tree: strings that each end in a zero.
    pub(super) fn of(compatible: &[u8]) -> Option<Layout> {
        compatible.split(|byte| *byte == 0).find_map(|name| match name {
            b"brcm,bcm2835-gpio" | b"brcm,bcm2711-gpio" => Some(Layout::Bcm2835),
            b"raspberrypi,rp1-gpio" => Some(Layout::Rp1),
            _ => None,
        })
    }

    /// The node whose driver maps the registers, and their length in bytes. The driver is bcm2835-gpiomem.c, or
    /// raspberrypi-gpiomem.c on newer kernels. Both are only in the Raspberry Pi's own kernel.
    pub(super) fn node(self) -> (&'static str, usize) {
        match self {
            Layout::Bcm2835 => ("gpiomem", 0x1000),
            Layout::Rp1 => ("gpiomem0", 0x30000),
        }
    }

    /// Whether the chip is behind a bus that holds stores back.
    pub(super) fn is_posted(self) -> bool {
        self == Layout::Rp1
    }

    /// Whether an emulated computer has tested it (tests/raspberry_pi). No emulator has an RP1.
    pub(super) fn is_tested(self) -> bool {
        self == Layout::Bcm2835
    }

    /// The registers of line `offset`. `at` has the register at an offset in bytes. `None` if there is no such line.
    pub(super) fn line<R: Register>(self, offset: u32, at: impl Fn(usize) -> Option<R>) -> Option<LineRegisters<R>> {
        match self {
            Layout::Bcm2835 => {
                let word = |first: usize, of: u32| at(first + 4 * (offset / of) as usize);
                let shift = offset % 10 * 3;
                let function =
                    Field { register: word(0x00, 10)?, mask: 7 << shift, input: 0 << shift, output: 1 << shift };
                (offset < 58).then_some(())?;
                Some(LineRegisters {
                    mask: 1 << (offset % 32),
                    bank: RegisterBank { set: word(0x1c, 32)?, clear: word(0x28, 32)?, posted: None },
                    level: word(0x34, 32)?,
                    direction: vec![function],
                })
            }
            Layout::Rp1 => {
                let (bank, bit) = match offset {
                    0..28 => (0, offset),
                    28..34 => (1, offset - 28),
                    34..54 => (2, offset - 34),
                    _ => return None,
                };
                let mask = 1 << bit;
                let io = |register: usize| at(0x4000 * bank + register);
                let rio = |register: usize| at(0x10000 + 0x4000 * bank + register);
                // CTRL: FUNCSEL is 5 if RIO drives the line. OUTOVER and OEOVER must be 0: they override RIO.
                let control = Field { register: io(8 * bit as usize + 4)?, mask: 0xf01f, input: 5, output: 5 };
                let enable = Field { register: rio(0x04)?, mask, input: 0, output: mask };
                Some(LineRegisters {
                    mask,
                    // RIO_OUT, by the addresses that set and clear bits, and RIO_IN.
                    bank: RegisterBank { set: rio(0x2000)?, clear: rio(0x3000)?, posted: Some(rio(0x08)?) },
                    level: rio(0x08)?,
                    direction: vec![control, enable],
                })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::io;
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicU32, Ordering::SeqCst};
    use std::thread;

    use pinion_firmware::board::Bank;
    use proptest::prelude::*;

    use super::*;

    /// A chip as its data sheet has it, with the world outside its pins.
    struct Model {
        layout: Layout,
        /// Each word of the block. A register that sets or clears bits has no word of its own.
        words: Vec<AtomicU32>,
        /// Levels from outside, by the bank of the level registers. They count where the chip drives nothing.
        outside: [AtomicU32; 3],
        /// As the kernel's driver has one for the directions.
        lock: Mutex<()>,
        /// The register that was read last.
        last_load: AtomicU32,
    }

    #[derive(Clone, Copy)]
    struct ModelRegister<'a>(&'a Model, usize);

    impl PartialEq for ModelRegister<'_> {
        fn eq(&self, other: &Self) -> bool {
            self.1 == other.1
        }
    }

    impl Register for ModelRegister<'_> {
        fn load(self) -> u32 {
            self.0.last_load.store(self.1 as u32, SeqCst);
            self.0.load(self.1)
        }

        fn store(self, value: u32) {
            self.0.store(self.1, value);
        }

        fn wait() {
            WAITS.set(WAITS.get() + 1);
        }
    }

    thread_local! {
        /// How often this thread has waited until its stores and loads had reached their device.
        static WAITS: Cell<u32> = const { Cell::new(0) };
    }

    impl Model {
        fn new(layout: Layout) -> Model {
            let words = (0..layout.node().1 / 4).map(|_| AtomicU32::new(0)).collect();
            Model { layout, words, outside: Default::default(), lock: Mutex::new(()), last_load: AtomicU32::new(0) }
        }

        fn line(&self, offset: u32) -> LineRegisters<ModelRegister<'_>> {
            self.layout.line(offset, |at| self.at(at)).expect("a line")
        }

        fn at(&self, at: usize) -> Option<ModelRegister<'_>> {
            (at.is_multiple_of(4) && at < self.layout.node().1).then_some(ModelRegister(self, at))
        }

        fn word(&self, at: usize) -> &AtomicU32 {
            &self.words[at / 4]
        }

        fn load(&self, at: usize) -> u32 {
            match (self.layout, at) {
                (Layout::Bcm2835, 0x34 | 0x38) => {
                    let bank = (at - 0x34) / 4;
                    let drives = (0..32).filter(|bit| {
                        let line = 32 * bank + bit;
                        self.word(line / 10 * 4).load(SeqCst) >> (line % 10 * 3) & 7 == 1
                    });
                    let drives = drives.fold(0, |mask, bit| mask | 1 << bit);
                    self.word(0x1c + 4 * bank).load(SeqCst) & drives | self.outside[bank].load(SeqCst) & !drives
                }
                // "Write only": the data sheet promises nothing for reading.
                (Layout::Bcm2835, 0x1c | 0x20 | 0x28 | 0x2c) => 0xdead_beef,
                (Layout::Rp1, 0x10000..0x1c000) if at % 0x4000 == 8 => {
                    let bank = (at - 0x10000) / 0x4000;
                    let (out, enable) = (self.word(at - 8).load(SeqCst), self.word(at - 4).load(SeqCst));
                    out & enable | self.outside[bank].load(SeqCst) & !enable
                }
                _ => self.word(at).load(SeqCst),
            }
        }

        fn store(&self, at: usize, value: u32) {
            match (self.layout, at) {
                (Layout::Bcm2835, 0x1c | 0x20) => drop(self.word(at).fetch_or(value, SeqCst)),
                (Layout::Bcm2835, 0x28 | 0x2c) => drop(self.word(at - 0xc).fetch_and(!value, SeqCst)),
                (Layout::Bcm2835, 0x34 | 0x38) => (),
                (Layout::Rp1, 0x10000..0x1c000) => match at % 0x4000 {
                    alias @ 0x1000..0x2000 => drop(self.word(at - alias + alias % 0x1000).fetch_xor(value, SeqCst)),
                    alias @ 0x2000..0x3000 => drop(self.word(at - alias + alias % 0x1000).fetch_or(value, SeqCst)),
                    alias @ 0x3000.. => drop(self.word(at - alias + alias % 0x1000).fetch_and(!value, SeqCst)),
                    _ => self.word(at).store(value, SeqCst),
                },
                _ => self.word(at).store(value, SeqCst),
            }
        }

        /// As the driver's `direction_output` and `direction_input`.
        fn kernel_turns(&self, line: u32, output: Option<bool>) {
            if let Some(level) = output {
                self.kernel_sets(line, level);
            }
            let _lock = self.lock.lock().unwrap();
            for Field { register, mask, input, output: out } in self.line(line).direction {
                let value = if output.is_some() { out } else { input };
                register.store(register.load() & !mask | value);
            }
        }

        /// As the driver's `set`: by the addresses in the driver, written out.
        fn kernel_sets(&self, line: u32, level: bool) {
            let (at, bit) = match (self.layout, line) {
                (Layout::Bcm2835, _) => ((if level { 0x1c } else { 0x28 }) + line / 32 * 4, line % 32),
                (Layout::Rp1, 0..28) => (0x12000 + 0x1000 * u32::from(!level), line),
                (Layout::Rp1, 28..34) => (0x16000 + 0x1000 * u32::from(!level), line - 28),
                (Layout::Rp1, _) => (0x1a000 + 0x1000 * u32::from(!level), line - 34),
            };
            self.store(at as usize, 1 << bit);
        }

        /// The level of the pin, as a meter shows it.
        fn kernel_gets(&self, line: u32) -> bool {
            let (at, bit) = match (self.layout, line) {
                (Layout::Bcm2835, _) => (0x34 + line / 32 * 4, line % 32),
                (Layout::Rp1, 0..28) => (0x10008, line),
                (Layout::Rp1, 28..34) => (0x14008, line - 28),
                (Layout::Rp1, _) => (0x18008, line - 34),
            };
            self.load(at as usize) >> bit & 1 != 0
        }

        fn drive(&self, line: u32, level: bool) {
            let (bank, bit) = match (self.layout, line) {
                (Layout::Bcm2835, _) => (line / 32, line % 32),
                (Layout::Rp1, 0..28) => (0, line),
                (Layout::Rp1, 28..34) => (1, line - 28),
                (Layout::Rp1, _) => (2, line - 34),
            };
            let bank = &self.outside[bank as usize];
            if level {
                bank.fetch_or(1 << bit, SeqCst)
            } else {
                bank.fetch_and(!(1 << bit), SeqCst)
            };
        }
    }

    const LAYOUTS: [Layout; 2] = [Layout::Bcm2835, Layout::Rp1];
    const LINES: u32 = 54;

    #[test]
    fn a_line_is_written_and_read_and_no_other_line_changes() {
        for layout in LAYOUTS {
            let model = Model::new(layout);
            (0..LINES).for_each(|line| model.kernel_turns(line, Some(false)));
            for line in 0..LINES {
                let registers = model.line(line);
                assert!(registers.is(true) && !registers.is(false));
                registers.write(true);
                let high: Vec<u32> = (0..LINES).filter(|line| model.kernel_gets(*line)).collect();
                assert_eq!(high, [line], "{layout:?}");
                assert!(registers.read());
                registers.write(false);
                assert!(!registers.read() && !model.kernel_gets(line));
            }
        }
        let bcm2835 = Model::new(Layout::Bcm2835);
        assert!(Layout::Bcm2835.line(58, |at| bcm2835.at(at)).is_none());
        assert!(Layout::Rp1.line(54, |at| bcm2835.at(at)).is_none());
    }

    #[derive(Clone, Copy, Debug)]
    enum Op {
        Registers(u32, bool),
        /// One store for each level, if both lines are in one bank.
        Together([(u32, bool); 2]),
        Kernel(u32, bool),
        Output(u32, bool),
        Input(u32),
        Outside(u32, bool),
    }

    fn op() -> impl Strategy<Value = Op> {
        let line = 0..LINES;
        prop_oneof![
            4 => (line.clone(), any::<bool>()).prop_map(|(line, level)| Op::Registers(line, level)),
            4 => [(line.clone(), any::<bool>()), (line.clone(), any::<bool>())].prop_map(Op::Together),
            4 => (line.clone(), any::<bool>()).prop_map(|(line, level)| Op::Kernel(line, level)),
            1 => (line.clone(), any::<bool>()).prop_map(|(line, level)| Op::Output(line, level)),
            1 => line.clone().prop_map(Op::Input),
            1 => (line, any::<bool>()).prop_map(|(line, level)| Op::Outside(line, level)),
        ]
    }

    proptest! {
        #[test]
        fn a_line_is_as_the_last_one_said_whichever_way_it_was_said(
            layout in prop::sample::select(&LAYOUTS[..]),
            ops in prop::collection::vec(op(), 0..200),
        ) {
            let model = Model::new(layout);
            (0..LINES).for_each(|line| model.kernel_turns(line, None));
            // Whether it is an output, its set level, and the level outside.
            let mut lines = [(false, false, false); LINES as usize];
            for op in ops {
                match op {
                    Op::Registers(line, level) => { model.line(line).write(level); lines[line as usize].1 = level; }
                    Op::Together([(line, _), (other, _)])
                        if line == other || model.line(line).bank != model.line(other).bank => {}
                    Op::Together(edges) => {
                        let mask = |of| edges.iter().filter(|edge| edge.1 == of)
                            .fold(0, |mask, edge| mask | model.line(edge.0).mask());
                        model.line(edges[0].0).bank.change(mask(true), mask(false));
                        edges.iter().for_each(|(line, level)| lines[*line as usize].1 = *level);
                    }
                    Op::Kernel(line, level) => { model.kernel_sets(line, level); lines[line as usize].1 = level; }
                    Op::Output(line, level) => {
                        model.kernel_turns(line, Some(level));
                        let state = &mut lines[line as usize];
                        (state.0, state.1) = (true, level);
                    }
                    Op::Input(line) => { model.kernel_turns(line, None); lines[line as usize].0 = false; }
                    Op::Outside(line, level) => { model.drive(line, level); lines[line as usize].2 = level; }
                }
                for (line, (output, set, outside)) in (0..).zip(lines) {
                    let level = if output { set } else { outside };
                    prop_assert_eq!((model.line(line).read(), model.kernel_gets(line)), (level, level));
                    prop_assert!(model.line(line).is(output));
                }
            }
        }
    }

    #[test]
    fn two_threads_write_neighbours_of_one_bank_in_both_ways() {
        for layout in LAYOUTS {
            let model = &Model::new(layout);
            (16..19).for_each(|line| model.kernel_turns(line, Some(false)));
            thread::scope(|scope| {
                scope.spawn(move || {
                    let line = model.line(17);
                    for round in 0..20_000 {
                        line.write(round % 3 == 0);
                        assert_eq!(line.read(), round % 3 == 0, "the registers' line keeps its level");
                    }
                });
                scope.spawn(move || {
                    for round in 0..20_000 {
                        model.kernel_sets(18, round % 2 == 0);
                        assert_eq!(model.kernel_gets(18), round % 2 == 0, "and so does the kernel's");
                    }
                });
                // The driver turns another line of the same function register at that moment.
                scope.spawn(move || {
                    (0..5_000).for_each(|_| {
                        model.kernel_turns(16, None);
                        model.kernel_turns(16, Some(true));
                    })
                });
            });
        }
    }

    #[test]
    fn a_store_behind_a_bus_that_holds_it_back_is_read_back() {
        for (layout, line, read_back) in [
            (Layout::Bcm2835, 17, None),
            (Layout::Rp1, 17, Some(0x10008)),
            (Layout::Rp1, 30, Some(0x14008)),
            (Layout::Rp1, 40, Some(0x18008)),
        ] {
            let model = Model::new(layout);
            let registers = model.line(line);
            assert_eq!(registers.is_posted(), read_back.is_some());
            registers.write(true);
            model.last_load.store(0, SeqCst);
            let waits = WAITS.get();
            registers.flush();
            assert_eq!(WAITS.get(), waits + 1, "a barrier is after the store and the load");
            assert_eq!(model.last_load.load(SeqCst), read_back.unwrap_or(0), "{layout:?} {line}");
        }
    }

    #[test]
    fn registers_that_agree_with_the_kernel_are_trusted() {
        for layout in LAYOUTS {
            let model = Model::new(layout);
            for (line, output) in [(17, Some(true)), (18, Some(false)), (33, None), (40, Some(true))] {
                model.kernel_turns(line, output);
                let before = model.words.iter().map(|word| word.load(SeqCst)).collect::<Vec<_>>();
                assert_eq!(model.line(line).check(output, || Ok(model.kernel_gets(line))), Ok(()), "{line}");
                let after = model.words.iter().map(|word| word.load(SeqCst)).collect::<Vec<_>>();
                assert_eq!(before, after, "the check changes nothing");
            }
        }
    }

    #[test]
    fn registers_of_another_line_or_function_are_not_trusted() {
        const DIRECTION: Result<(), &str> = Err("the direction in its registers is not the kernel's");
        const LEVEL: Result<(), &str> = Err("the level in its registers is not the kernel's");
        for layout in LAYOUTS {
            let model = Model::new(layout);
            model.kernel_turns(17, Some(true));
            model.kernel_turns(18, Some(false));
            model.kernel_turns(19, None);
            let kernel = |line| model.kernel_gets(line);
            assert_eq!(model.line(19).check(Some(true), || Ok(kernel(17))), DIRECTION);
            assert_eq!(model.line(17).check(None, || Ok(kernel(19))), DIRECTION);
            assert_eq!(model.line(18).check(Some(true), || Ok(kernel(17))), LEVEL);
            assert!(!kernel(18), "and nothing was written");
            assert_eq!(model.line(17).check(Some(true), || Err(io::Error::other("it is gone"))), LEVEL);
        }
        // RP1: another block drives the line, or an override does.
        let model = Model::new(Layout::Rp1);
        model.kernel_turns(17, Some(true));
        for control in [4, 0x1005, 0x4005] {
            model.store(17 * 8 + 4, control);
            assert_eq!(model.line(17).check(Some(true), || Ok(true)), DIRECTION);
        }
    }

    /// A level that changes between two reads is no reason to distrust them.
    #[test]
    fn an_input_may_change_during_the_check() {
        let model = Model::new(Layout::Bcm2835);
        model.kernel_turns(24, None);
        let looks = Cell::new(0);
        let kernel = || {
            looks.set(looks.get() + 1);
            model.drive(24, looks.get() % 2 == 1 || looks.get() > 10);
            Ok(model.kernel_gets(24))
        };
        assert_eq!(model.line(24).check(None, kernel), Ok(()));
        assert!(looks.get() > 10);
    }
}
