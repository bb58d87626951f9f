// Line icons of 16 x 16.

const PATHS = {
  home: "M2.5 7.5 8 3l5.5 4.5M4 6.5V13h8V6.5",
  share: "M6 10 10 6M7 4.5l1.5-1.5a3 3 0 0 1 4.2 4.2L11.300 8.700M9 11.500l-1.500 1.500a3 3 0 0 1-4.200-4.200L4.700 7.300",
  theme: "M8 2.500a5.500 5.500 0 1 0 0 11zM8 2.500a5.500 5.500 0 0 1 0 11",
  help: "M6 6a2 2 0 1 1 3 1.700c-.7.4-1 .8-1 1.600M8 11.800v.1M8 1.800a6.200 6.200 0 1 0 0 12.400A6.200 6.200 0 0 0 8 1.800",
  panel: "M2 3h12v10H2zM10 3v10",
  measure: "M2 11 11 2l3 3-9 9zM5 8l1.500 1.500M7 6l1 1M9 4l1.500 1.500",
  inspect: "M7 2.500a4.500 4.500 0 1 0 0 9 4.500 4.500 0 0 0 0-9M10.500 10.500 14 14",
  frusta: "M2 4l8-2v12l-8-2zM10 6l4-2v8l-4-2",
  previous: "M10 3 5 8l5 5",
  next: "M6 3l5 5-5 5",
  play: "M5 3l8 5-8 5z",
  pause: "M5 3v10M11 3v10",
  add: "M8 3v10M3 8h10",
  remove: "M4 4l8 8M12 4l-8 8",
  headset: "M2 5h12v6h-3.500L9 9.500H7L5.500 11H2z",
};

/** @param {keyof typeof PATHS} name */
export function icon(name) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 16 16");
  svg.setAttribute("aria-hidden", "true");
  const path = document.createElementNS(svg.namespaceURI, "path");
  path.setAttribute("d", PATHS[name]);
  svg.append(path);
  return svg;
}
