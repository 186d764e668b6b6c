// The page: its tabs, its theme and its charts' controls.
const root = document.documentElement;
const make = (tag, attributes, ...children) => {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
};

// Tabs -------------------------------------------------------------------------------------------
const sections = [...document.querySelectorAll("section[data-tab]")];
const tabs = sections.map((section) =>
  make(
    "button",
    {
      type: "button",
      role: "tab",
      id: `tab-${section.id}`,
      "aria-controls": section.id,
    },
    section.dataset.tab,
  ),
);
const select = (k, focus) => {
  sections.forEach((section, j) => {
    section.hidden = j !== k;
    tabs[j].setAttribute("aria-selected", j === k);
    tabs[j].tabIndex = j === k ? 0 : -1;
  });
  if (focus) tabs[k].focus();
  drawAll();
};
const list = make("div", { role: "tablist", "aria-label": "Parts of the report" }, ...tabs);
sections[0].before(list);
tabs.forEach((tab, k) => {
  const section = sections[k];
  section.setAttribute("role", "tabpanel");
  section.setAttribute("aria-labelledby", tab.id);
  tab.addEventListener("click", () => select(k));
  tab.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    const ends = { Home: 0, End: tabs.length - 1 }[event.key];
    if (step === undefined && ends === undefined) return;
    event.preventDefault();
    select(ends ?? (k + step + tabs.length) % tabs.length, true);
  });
});

// Wide tables say so, and on which side there is more -------------------------------------------
const boxes = [...document.querySelectorAll(".scroll")];
const mark = (box) => {
  const rest = box.scrollWidth - box.clientWidth;
  box.classList.toggle("wide", rest > 1);
  box.classList.toggle("more-left", box.scrollLeft > 1);
  box.classList.toggle("more-right", rest - box.scrollLeft > 1);
};
const seen = new ResizeObserver((entries) => entries.forEach((entry) => mark(entry.target)));
boxes.forEach((box) => {
  seen.observe(box);
  box.addEventListener("scroll", () => mark(box), { passive: true });
});

// Theme ------------------------------------------------------------------------------------------
const themes = ["auto", "light", "dark"];
const themeButton = make("button", { type: "button", class: "theme" }, "theme: auto");
themeButton.addEventListener("click", () => {
  const next = themes[(themes.indexOf(root.dataset.theme ?? "auto") + 1) % 3];
  root.dataset.theme = next;
  themeButton.textContent = `theme: ${next}`;
  drawAll();
});
document.querySelector("header").append(themeButton);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => drawAll());

// Figures ----------------------------------------------------------------------------------------
const swatch = (run) => {
  const line = make("span", { class: "swatch", "aria-hidden": "true" });
  line.style.borderTopColor = `var(--run-${run.style})`;
  line.style.borderTopStyle = run.dashes.length ? "dashed" : "solid";
  return line;
};
const legendButtons = (k) => {
  const run = data.runs[k];
  const button = make(
    "button",
    { type: "button", "aria-pressed": "true", class: "run" },
    swatch(run),
    run.label,
  );
  button.addEventListener("click", () => {
    hidden.has(k) ? hidden.delete(k) : hidden.add(k);
    document
      .querySelectorAll(`[data-run="${k}"]`)
      .forEach((each) => each.setAttribute("aria-pressed", !hidden.has(k)));
    drawAll();
  });
  button.dataset.run = k;
  return button;
};
for (const figure of data.figures) {
  const place = document.getElementById(figure.name);
  const runs = [...new Set(figure.panels.flatMap((panel) => panel.lines.map((line) => line.run)))];
  const bar = make("div", { class: "controls" }, ...runs.filter((k) => k >= 0).map(legendButtons));
  if (runs.includes(-1)) bar.append(make("span", { class: "soft" }, "thick grey: reference"));
  if (figure.mark) bar.append(make("span", { class: "soft" }, `dotted: ${figure.mark}`));
  const buttons = [
    ["+", "zoom in", 0.5],
    ["\u2212", "zoom out", 2],
    ["reset", "whole", 0],
  ];
  const group = make("span", { class: "zoom" });
  for (const [text, name, factor] of buttons) {
    const button = make("button", { type: "button", title: name, "aria-label": name }, text);
    button.addEventListener("click", () =>
      figure.charts
        .slice(0, figure.free ? 99 : 1)
        .forEach((chart) => (factor ? chart.zoomBy(factor) : chart.reset())),
    );
    group.append(button);
  }
  bar.append(group);
  const panels = make("div", { class: "panels" });
  figure.charts = figure.panels.map((panel) => new Chart(figure, panel, panels));
  panels.classList.toggle("single", figure.panels.length < 2);
  place.append(bar, panels);
}
// What is folded is printed, too.
const folded = [];
addEventListener("beforeprint", () => {
  folded.push(...document.querySelectorAll("details:not([open])"));
  folded.forEach((each) => {
    each.open = true;
  });
  drawAll();
});
addEventListener("afterprint", () => {
  folded.splice(0).forEach((each) => {
    each.open = false;
  });
});
select(0);
new ResizeObserver(() => drawAll()).observe(document.querySelector("main"));
