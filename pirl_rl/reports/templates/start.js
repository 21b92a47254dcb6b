"use strict";
// Unpacking of the data of the page, and of the chart library, which it carries in compressed form.

const dark = matchMedia("(prefers-color-scheme: dark)");
let printing = false;

async function unzipped(text) {
  const bytes = Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Numbers of `width` bytes, which were written as differences, one plane of bytes after the other.
async function unpacked(text, width) {
  const bytes = await unzipped(text);
  const count = bytes.length / width;
  const codes = width === 2 ? new Uint16Array(count) : new Uint8Array(count);
  for (let i = 0, code = 0; i < count; i++) {
    let step = 0;
    for (let k = 0; k < width; k++) step = 256 * step + bytes[k * count + i];
    codes[i] = code + step;
    code = codes[i];
  }
  return codes;
}

async function loadLibrary() {
  const program = document.createElement("script");
  program.textContent = new TextDecoder().decode(await unzipped(document.getElementById("library").textContent));
  document.head.append(program);
}

function dataOf(element) {
  return JSON.parse(document.getElementById(`data-${element.dataset.run}`).textContent);
}

// A number for an eye: four digits.
function short(value) {
  return String(Number(value.toPrecision(4)));
}
