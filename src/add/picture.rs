// SPDX-License-Identifier: GPL-3.0-or-later
//! The header of a board with the wires to make, in the terminal and as SVG.

use crate::page::{Page, aligned};
use pinion_linux::foreign::plain_xml;

use super::place::Wire;
use pinion_system::board::Board;

/// A table of the wires, and the header with them.
pub(super) fn page(board: &Board, wires: &[Wire]) -> Page {
    let mut page = Page::default();
    let place = |pin: usize| match &board.connector {
        None => format!("pin {pin}"),
        Some(_) => String::new(),
    };
    let mut rows = vec![vec!["wire".to_owned(), "to".to_owned(), String::new()]];
    rows.extend(wires.iter().map(|wire| vec![wire.chip.clone(), place(wire.pin), board.label(wire.pin).to_owned()]));
    aligned(&rows).iter().for_each(|line| page.line(format_args!("  {line}")));
    page.line("");
    page.append(&header(board, wires));
    page
}

/// The header, with a name beside each of these pins.
pub(crate) fn header(board: &Board, wires: &[Wire]) -> Page {
    let mut page = Page::default();
    let wired = |pin: usize| wires.iter().find(|wire| wire.pin == pin).map(|wire| wire.chip.as_str());
    if let Some(connector) = &board.connector {
        page.line(format_args!("  {connector}"));
        return page;
    }
    // Pin 1 is at the top left, as on the boards' own pictures.
    let width = board.pins.iter().map(|pin| pin.chars().count()).max().unwrap_or(0);
    let outer = wires.iter().map(|wire| wire.chip.chars().count()).max().unwrap_or(0);
    for (row, pair) in board.pins.chunks(2).enumerate() {
        let (odd, even) = (2 * row + 1, 2 * row + 2);
        let mark = |pin: usize| if wired(pin).is_some() { '*' } else { 'o' };
        let left = wired(odd).map_or(String::new(), |chip| format!("{chip} --"));
        let right = wired(even).map_or(String::new(), |chip| format!("-- {chip}"));
        let second = pair.get(1).map_or("", String::as_str);
        page.line(
            format!(
                "  {left:>outer$} {:>width$} {odd:>2} {} {} {even:<2} {second:<width$} {right}",
                pair[0],
                mark(odd),
                mark(even),
                outer = outer + 3,
            )
            .trim_end(),
        );
    }
    page
}

/// The header as a picture.
pub(crate) fn svg(board: &Board, title: &str, wires: &[Wire]) -> String {
    const ROW: usize = 22;
    const TOP: usize = 56;
    let columns = if board.connector.is_some() { 1 } else { 2 };
    let rows = board.pins.len().div_ceil(columns);
    let height = TOP + rows * ROW + 40;
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 640 {height}\" font-family=\"sans-serif\" \
         font-size=\"13\">\n<rect width=\"640\" height=\"{height}\" fill=\"#fff\"/>\n\
         <text x=\"320\" y=\"22\" text-anchor=\"middle\" font-size=\"16\">{}</text>\n\
         <text x=\"320\" y=\"42\" text-anchor=\"middle\" fill=\"#555\">{}</text>\n",
        plain_xml(title),
        plain_xml(&format!("{} - {}", board.name, board.level)),
    );
    for (index, label) in board.pins.iter().enumerate() {
        let (pin, row, is_left) = (index + 1, index / columns, index % columns == 0);
        let y = TOP + row * ROW + ROW / 2;
        let (x, edge, anchor) = if is_left { (308, 285, "end") } else { (332, 355, "start") };
        let wire = wires.iter().find(|wire| wire.pin == pin);
        let fill = match label.as_str() {
            "GND" => "#222",
            "5 V" => "#c22",
            "3.3 V" => "#e80",
            _ if wire.is_some() => "#28c",
            _ => "#bbb",
        };
        out += &format!("<circle cx=\"{x}\" cy=\"{y}\" r=\"8\" fill=\"{fill}\"/>\n");
        let text = y + 4;
        if board.connector.is_none() {
            out += &format!(
                "<text x=\"{x}\" y=\"{text}\" text-anchor=\"middle\" font-size=\"9\" fill=\"#fff\">{pin}</text>\n"
            );
        }
        let weight = if wire.is_some() { "bold" } else { "normal" };
        out += &format!(
            "<text x=\"{edge}\" y=\"{text}\" text-anchor=\"{anchor}\" font-weight=\"{weight}\">{}</text>\n",
            plain_xml(label)
        );
        if let Some(wire) = wire {
            let (from, to, at) = if is_left { (180, 120, 114) } else { (460, 520, 526) };
            out += &format!(
                "<path d=\"M{from} {y}H{to}\" stroke=\"{fill}\" stroke-width=\"3\"/>\n\
                 <text x=\"{at}\" y=\"{text}\" text-anchor=\"{anchor}\">{}</text>\n",
                plain_xml(&wire.chip)
            );
        }
    }
    if let Some(connector) = &board.connector {
        let y = height - 14;
        out += &format!("<text x=\"320\" y=\"{y}\" text-anchor=\"middle\">{}</text>\n", plain_xml(connector));
    }
    out + "</svg>\n"
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::add::catalog::Catalog;
    use crate::add::place::Search;
    use crate::tree::Tree;
    use pinion_system::uses::Uses;
    use std::collections::BTreeMap;

    fn adxl345(tree: &Tree) -> (Board, Vec<Wire>) {
        let catalog = Catalog::read().unwrap();
        let computer = tree.computer();
        let board = Board::of(&computer, None).unwrap().unwrap();
        let uses = Uses::find(&computer, Some(&board), None, None);
        let search = Search { board: &board, uses: &uses, own: None, there: None };
        let device = catalog.device("adxl345").unwrap();
        let way = &device.way[0];
        let wires = search.wires(device, way, &search.spots(way)[0], &BTreeMap::new(), None).unwrap();
        (board, wires)
    }

    #[test]
    fn each_wire_is_drawn_at_its_pin() {
        for model in ["Raspberry Pi 4 Model B", "BigTreeTech CB1", "OrangePi Zero3"] {
            let tree = Tree::empty();
            tree.put("proc/device-tree/model", model);
            let (board, wires) = adxl345(&tree);
            let text = page(&board, &wires).to_string();
            let rows: Vec<&str> = text.lines().skip_while(|line| !line.is_empty()).skip(1).collect();
            assert_eq!(rows.len(), board.pins.len() / 2, "{text}");
            assert!(rows[0].starts_with("  VCC or 3V3 --") && rows[0].contains(" 1 * o 2 "), "{text}");
            assert_eq!(text.matches(" --").count(), wires.len(), "{text}");
            let pin_19 = rows[9];
            assert!(pin_19.contains("SDA --") && pin_19.contains("19 *"), "{text}");
            let svg = svg(&board, "<ADXL345>", &wires);
            let document = roxmltree::Document::parse(&svg).unwrap();
            assert_eq!(document.descendants().filter(|node| node.has_tag_name("path")).count(), wires.len());
            assert!(svg.contains("&lt;ADXL345&gt;"));
        }
    }

    #[test]
    fn a_connector_has_names_instead_of_numbers() {
        let tree = Tree::empty();
        tree.put("proc/device-tree/model", "BigTreeTech CB1\0");
        tree.put("boot/system.cfg", "BTT_PAD7=\"ON\"\n");
        let (board, wires) = adxl345(&tree);
        let text = page(&board, &wires).to_string();
        assert!(text.contains("the connector SPI") && !text.contains("pin "), "{text}");
        assert!(!svg(&board, "x", &wires).contains(">1<"));
    }
}
