//! The plot: small panels of lines over the sizes, as SVG, and below them bars of what is measured apart.

use std::fmt::Write;

use crate::contender::Contender;
use crate::plan::{Cell, Pace, Plan};
use crate::results::{Figure, Once, Results};
use crate::table::bytes;

/// Panels that share a scale: what they show, at which pace.
const ROWS: [(&str, Pace, Figure); 3] = [
    ("p50, us", Pace::Steady, |reading| reading.p50_us),
    ("samples/s", Pace::Max, |reading| reading.per_second),
    ("samples/CPU s", Pace::Max, |reading| reading.per_cpu_second),
];

/// A rectangle on the page with a logarithmic scale upwards.
struct Panel {
    left: f64,
    top: f64,
    /// Powers of ten at the bottom and at the top.
    low: f64,
    high: f64,
}

/// Draws all.
pub(crate) fn to_svg(results: &Results, contenders: &[&'static Contender], plan: &Plan) -> String {
    let mut groups: Vec<(usize, u8)> = Vec::new();
    for cell in &plan.cells {
        if !groups.contains(&(cell.subscribers, cell.loss_percent)) {
            groups.push((cell.subscribers, cell.loss_percent));
        }
    }
    let columns = groups.len().max(Once::ALL.len()) as f64;
    let width = MARGIN + columns * (PANEL_WIDTH + GAP);
    let legend = LEGEND_LINE * (contenders.len() as f64 + 1.0);
    let bars = PANEL_HEIGHT.max(legend) + 2.0 * GAP;
    let height = TOP + ROWS.len() as f64 * (PANEL_HEIGHT + GAP) + bars;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" \
         font-size=\"10\">\n<rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n"
    );
    for (row, (label, pace, figure)) in ROWS.iter().enumerate() {
        let all = plan.cells.iter().filter(|cell| cell.pace == *pace);
        let figures = all.flat_map(|cell| {
            contenders
                .iter()
                .map(|contender| results.figure(contender.name, *cell, *figure))
        });
        let Some((low, high)) = decades(figures) else {
            continue;
        };
        for (column, &(subscribers, loss_percent)) in groups.iter().enumerate() {
            let panel = Panel {
                left: MARGIN + column as f64 * (PANEL_WIDTH + GAP),
                top: TOP + row as f64 * (PANEL_HEIGHT + GAP),
                low,
                high,
            };
            panel.frame(&mut svg, column == 0);
            let group = format!("1 to {subscribers}, {loss_percent} % loss: {label}");
            text(&mut svg, panel.left, panel.top - 6.0, &group);
            for (index, size) in plan.sizes.iter().enumerate() {
                text(
                    &mut svg,
                    panel.x(index, plan.sizes.len()) - 12.0,
                    panel.bottom() + 11.0,
                    &bytes(*size),
                );
            }
            for (order, contender) in contenders.iter().enumerate() {
                let figures = plan.sizes.iter().map(|&size| {
                    let cell = Cell {
                        subscribers,
                        loss_percent,
                        size,
                        pace: *pace,
                    };
                    results.figure(contender.name, cell, *figure)
                });
                panel.line(&mut svg, color(order), contender.name, figures.collect());
            }
        }
    }
    let top = TOP + ROWS.len() as f64 * (PANEL_HEIGHT + GAP) + GAP / 2.0;
    for (column, once) in Once::ALL.iter().enumerate() {
        let figures: Vec<f64> = contenders
            .iter()
            .map(|contender| results.once(contender.name, *once))
            .collect();
        let Some((low, high)) = decades(figures.iter().copied()) else {
            continue;
        };
        let panel = Panel {
            left: MARGIN + column as f64 * (PANEL_WIDTH + GAP),
            top,
            low,
            high,
        };
        panel.frame(&mut svg, true);
        text(&mut svg, panel.left, top - 6.0, once.head());
        panel.bars(&mut svg, contenders, &figures);
    }
    for (order, contender) in contenders.iter().enumerate() {
        let (x, y) = (
            MARGIN + Once::ALL.len() as f64 * (PANEL_WIDTH + GAP),
            top + LEGEND_LINE * order as f64,
        );
        // Without a column of its own the legend lies over the last bars' empty corner.
        let x = x.min(width - PANEL_WIDTH * 0.7);
        let fill = color(order);
        push(
            &mut svg,
            format_args!("<rect x=\"{x}\" y=\"{y}\" width=\"9\" height=\"9\" fill=\"{fill}\"/>"),
        );
        text(&mut svg, x + 13.0, y + 8.0, contender.name);
    }
    svg.push_str("</svg>\n");
    svg
}

impl Panel {
    fn frame(&self, svg: &mut String, has_labels: bool) {
        let (left, top) = (self.left, self.top);
        push(
            svg,
            format_args!(
                "<rect x=\"{left}\" y=\"{top}\" width=\"{PANEL_WIDTH}\" height=\"{PANEL_HEIGHT}\" fill=\"none\" stroke=\"#999\"/>"
            ),
        );
        let mut decade = self.low;
        while decade <= self.high {
            let y = self.y(10_f64.powf(decade));
            let right = left + PANEL_WIDTH;
            push(
                svg,
                format_args!(
                    "<line x1=\"{left}\" y1=\"{y:.1}\" x2=\"{right}\" y2=\"{y:.1}\" stroke=\"#ddd\"/>"
                ),
            );
            if has_labels {
                text(svg, left - 26.0, y + 3.0, &power(decade));
            }
            decade += 1.0;
        }
    }

    fn line(&self, svg: &mut String, color: &str, name: &str, figures: Vec<f64>) {
        let count = figures.len();
        let mut points = String::new();
        for (index, figure) in figures.into_iter().enumerate() {
            if figure > 0.0 {
                let (x, y) = (self.x(index, count), self.y(figure));
                points.push_str(&format!("{x:.1},{y:.1} "));
                push(
                    svg,
                    format_args!(
                        "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2\" fill=\"{color}\"><title>{name} {figure:.1}</title></circle>"
                    ),
                );
            }
        }
        push(
            svg,
            format_args!(
                "<polyline points=\"{}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.3\"/>",
                points.trim_end()
            ),
        );
    }

    fn bars(&self, svg: &mut String, contenders: &[&'static Contender], figures: &[f64]) {
        let step = PANEL_WIDTH / figures.len().max(1) as f64;
        for (order, (&figure, contender)) in figures.iter().zip(contenders).enumerate() {
            if figure > 0.0 {
                let (x, y) = (self.left + step * (order as f64 + 0.15), self.y(figure));
                let (width, height) = (step * 0.7, self.bottom() - y);
                let (fill, name) = (color(order), contender.name);
                push(
                    svg,
                    format_args!(
                        "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{height:.1}\" fill=\"{fill}\">\
                         <title>{name} {figure:.1}</title></rect>"
                    ),
                );
            }
        }
    }

    fn x(&self, index: usize, count: usize) -> f64 {
        self.left + PANEL_WIDTH * (index as f64 + 0.5) / count as f64
    }

    fn y(&self, figure: f64) -> f64 {
        let share = (figure.log10() - self.low) / (self.high - self.low);
        self.bottom() - PANEL_HEIGHT * share.clamp(0.0, 1.0)
    }

    fn bottom(&self) -> f64 {
        self.top + PANEL_HEIGHT
    }
}

/// The powers of ten around all figures above 0; none when there is no such figure.
fn decades(figures: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    let mut bounds: Option<(f64, f64)> = None;
    for log in figures.filter(|figure| *figure > 0.0).map(f64::log10) {
        let (low, high) = bounds.unwrap_or((log, log));
        bounds = Some((low.min(log), high.max(log)));
    }
    bounds.map(|(low, high)| (low.floor(), high.ceil().max(low.floor() + 1.0)))
}

fn power(decade: f64) -> String {
    match 10_f64.powf(decade) {
        value if value >= 1e6 => format!("{} M", value / 1e6),
        value if value >= 1e3 => format!("{} k", value / 1e3),
        value => format!("{value}"),
    }
}

fn color(order: usize) -> &'static str {
    COLORS[order % COLORS.len()]
}

fn text(svg: &mut String, x: f64, y: f64, words: &str) {
    push(
        svg,
        format_args!("<text x=\"{x:.1}\" y=\"{y:.1}\">{words}</text>"),
    );
}

fn push(svg: &mut String, element: std::fmt::Arguments<'_>) {
    // Writing to a string cannot fail.
    writeln!(svg, "{element}").ok();
}

const COLORS: [&str; 12] = [
    "#d62728", "#ff9896", "#7f7f7f", "#1f77b4", "#17becf", "#aec7e8", "#2ca02c", "#ff7f0e",
    "#9467bd", "#c5b0d5", "#8c564b", "#c49c94",
];
const MARGIN: f64 = 44.0;
const TOP: f64 = 28.0;
const GAP: f64 = 34.0;
const PANEL_WIDTH: f64 = 190.0;
const PANEL_HEIGHT: f64 = 150.0;
const LEGEND_LINE: f64 = 14.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contender::CONTENDERS;
    use crate::plan::SIZES;
    use crate::results::tests::{cell, reading};

    #[test]
    fn a_figure_is_a_mark_and_none_is_no_mark() {
        let mut results = Results::default();
        results.add("ddx", cell(0), reading(1_000.0));
        results.add("lcm", cell(0), reading(0.0));
        let contenders: Vec<_> = CONTENDERS.iter().collect();

        let svg = to_svg(&results, &contenders, &Plan::full(&SIZES));

        assert_eq!(svg.matches("<circle").count(), 2, "rate and rate by CPU");
        assert!(!svg.contains("NaN"));
    }

    #[test]
    fn a_scale_is_at_least_one_decade() {
        assert_eq!(decades([100.0].into_iter()), Some((2.0, 3.0)));
        assert_eq!(decades([5.0, 2_000.0].into_iter()), Some((0.0, 4.0)));
        assert_eq!(decades([0.0, f64::NAN].into_iter()), None);
    }
}
