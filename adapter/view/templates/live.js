"use strict";
(() => {
  const WINDOW_S = 20, SCALE_S = 5, GAP_S = 0.6, STALE_S = 3, FAST = 400, SLOW = 300;
  const by = (id) => document.getElementById(id);
  const make = (tag, text, kind) => {
    const node = document.createElement(tag);
    if (text !== undefined) node.textContent = text;
    if (kind) node.className = kind;
    return node;
  };
  const put = (node, text) => { if (node.textContent !== text) node.textContent = text; };
  const some = (x) => typeof x === "number" && Number.isFinite(x);

  // Numbers as people read them: so many digits, a true minus sign, no exponent.
  const number = (x, digits = 3) => {
    if (!some(x)) return "–";
    const size = Math.abs(x);
    if (size < 1e-9) return "0";
    if (size < 1e-4) return x.toExponential(1).replace(/-/g, "−");
    const decimals = Math.max(0, digits - 1 - Math.floor(Math.log10(size)));
    return x.toFixed(Math.min(decimals, 7)).replace("-", "−");
  };
  const measured = (x, std, unit) => {
    if (!some(x)) return "–";
    if (!some(std) || std <= 0) return `${number(x)} ${unit}`;
    const decimals = Math.min(Math.max(0, 1 - Math.floor(Math.log10(std))), 7);
    const told = (x.toFixed(decimals) * 1 === 0 ? 0 : x).toFixed(decimals);  // no minus before 0.00
    return `${told} ± ${std.toFixed(decimals)} ${unit}`.replace("-", "−");
  };
  const signed = (x, digits) => (x > 0 ? "+" : "") + number(x, digits);
  const count = (x) => String(x).replace(/\B(?=(\d{3})+$)/g, "\u202f");

  // Names without what all of them begin with: panda_joint1, panda_joint2 -> joint1, joint2.
  const shortened = (names) => {
    if (names.length < 2) return names;
    let k = 0;
    while (k < names[0].length && names.every((n) => n[k] === names[0][k])) k++;
    const cut = Math.max(names[0].lastIndexOf("_", k - 1), names[0].lastIndexOf("/", k - 1)) + 1;
    return names.map((n) => n.slice(cut));
  };

  let hello = null, frame = null, news = null, timing = null, chosen = -1;
  let frames = [], estimates = [], heard = 0, connected = false;
  let colors = {};
  const view = { turn: -55, lift: 18 };

  const readColors = () => {
    const style = getComputedStyle(document.documentElement);
    for (const name of ["ink", "muted", "grid", "line", "accent", "goal", "card", "wash"])
      colors[name] = style.getPropertyValue(`--${name}`).trim();
    for (let j = 1; j <= 8; j++) colors[`j${j}`] = style.getPropertyValue(`--j${j}`).trim();
  };
  readColors();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readColors(); drawAll(); });

  const surface = (canvas) => {
    const ratio = window.devicePixelRatio || 1;
    const w = canvas.clientWidth, h = canvas.clientHeight;
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
      canvas.width = Math.round(w * ratio);
      canvas.height = Math.round(h * ratio);
    }
    const g = canvas.getContext("2d");
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, w, h);
    g.font = "11px system-ui, sans-serif";
    return [g, w, h];
  };

  // A rounder number that is not smaller: 1, 2 or 5 times a power of ten.
  const rounder = (x) => {
    if (!(x > 0)) return 1;
    const power = 10 ** Math.floor(Math.log10(x));
    for (const step of [1, 2, 5]) if (x <= step * power * 1.0001) return step * power;
    return 10 * power;
  };

  const line = (g, points, x, y) => {
    g.beginPath();
    let before = null;
    for (const [t, v] of points) {
      if (!some(v)) { before = null; continue; }
      if (before === null || t - before > GAP_S) g.moveTo(x(t), y(v)); else g.lineTo(x(t), y(v));
      before = t;
    }
    g.stroke();
  };

  const band = (g, points, x, y) => {
    g.beginPath();
    points.forEach(([t, low, high], k) => { if (k) g.lineTo(x(t), y(high)); else g.moveTo(x(t), y(high)); });
    for (let k = points.length - 1; k >= 0; k--) g.lineTo(x(points[k][0]), y(points[k][1]));
    g.closePath();
    g.fill();
  };

  // ---- residual of each joint
  const residualPanels = [];
  const buildResiduals = () => {
    const place = by("residuals");
    place.replaceChildren();
    residualPanels.length = 0;
    hello.joints.forEach((name) => {
      const figure = make("figure"), caption = make("figcaption");
      const size = make("span"), word = make("span"), canvas = make("canvas");
      canvas.setAttribute("role", "img");
      caption.append(make("b", name), size);
      figure.append(caption, canvas, word);
      word.className = "note";
      place.append(figure);
      residualPanels.push({ size, word, canvas, name });
    });
  };

  const drawResiduals = () => {
    if (!frame) return;
    const end = frame.t, start = end - WINDOW_S;
    residualPanels.forEach((panel, j) => {
      const noise = frame.noise[j], rms = frame.rms[j];
      put(panel.size, some(rms) ? `${number(rms, 2)} of ±${number(noise, 2)} N m` : "");
      put(panel.word, frame.words[j]);
      panel.word.className = frame.words[j] === "as expected" || !some(rms) ? "note" : "note loud";
      panel.canvas.setAttribute("aria-label",
        `Residual of ${panel.name}: rms ${number(rms, 2)} N m, noise ${number(noise, 2)} N m, ${frame.words[j]}`);
      const [g, w, h] = surface(panel.canvas);
      const seen = frames.filter((f) => f.t >= start && some(f.residual[j]));
      const recent = seen.filter((f) => f.t >= end - SCALE_S).map((f) => Math.abs(f.residual[j]));
      const reach = rounder(Math.max(1.1 * Math.max(0, ...recent), 3.2 * (noise || 0)) || 1);
      const x = (t) => w * (t - start) / WINDOW_S;
      const y = (v) => h / 2 - (h / 2 - 2) * Math.max(-1, Math.min(1, v / reach));
      const bands = seen.filter((f) => some(f.noise[j])).map((f) => [f.t, -2 * f.noise[j], 2 * f.noise[j]]);
      g.fillStyle = colors.wash;
      if (bands.length > 1) band(g, bands, x, y);
      g.strokeStyle = colors.grid;
      g.lineWidth = 1;
      g.beginPath();
      for (const v of [-reach, 0, reach]) { g.moveTo(0, y(v)); g.lineTo(w, y(v)); }
      g.stroke();
      g.strokeStyle = colors[`j${j % 8 + 1}`];
      g.lineWidth = 1.3;
      line(g, seen.map((f) => [f.t, f.residual[j]]), x, y);
      g.fillStyle = colors.muted;
      if (seen.length) g.fillText(`±${number(reach, 1)}`, 3, 12);
      else { g.textAlign = "center"; g.fillText("θ is not learned yet", w / 2, h / 2 - 5); g.textAlign = "start"; }
    });
  };

  // ---- the arm
  const projected = () => {
    const turn = view.turn * Math.PI / 180, lift = view.lift * Math.PI / 180;
    const s = Math.sin(turn), c = Math.cos(turn), sl = Math.sin(lift), cl = Math.cos(lift);
    return (p) => [-s * p[0] + c * p[1], cl * p[2] - sl * (c * p[0] + s * p[1])];
  };

  const drawArm = () => {
    const canvas = by("arm"), [g, w, h] = surface(canvas);
    if (!frame || !frame.arms.documented) {
      g.fillStyle = colors.muted;
      g.textAlign = "center";
      g.fillText("No motion yet", w / 2, h / 2);
      g.textAlign = "start";
      return;
    }
    const reach = hello.reach_m, flat = projected();
    const scale = Math.min(h / (1.06 * reach), w / (1.5 * reach));
    const at = (p) => { const [a, b] = flat(p); return [w / 2 + scale * a, 0.86 * h - scale * b]; };
    const stroke = (points) => {
      g.beginPath();
      points.forEach((p, k) => { const [a, b] = at(p); if (k) g.lineTo(a, b); else g.moveTo(a, b); });
      g.stroke();
    };
    const side = 0.16 * reach;
    g.strokeStyle = colors.grid;
    g.lineWidth = 1;
    for (const k of [-1, 0, 1]) {
      stroke([[k * side, -side, 0], [k * side, side, 0]]);
      stroke([[-side, k * side, 0], [side, k * side, 0]]);
    }
    g.lineJoin = g.lineCap = "round";
    const bones = (arm, color, width, alpha) => {
      g.strokeStyle = color;
      g.lineWidth = width;
      g.globalAlpha = alpha;
      arm.joints.forEach((p, j) => {
        const i = hello.parents[j];
        stroke([i < 0 ? [0, 0, 0] : arm.joints[i], p]);
      });
      arm.tips.forEach((p, k) => stroke([arm.joints[arm.tip_of[k]], p]));
      g.globalAlpha = 1;
    };
    bones(frame.arms.documented, colors.muted, 9, 0.3);
    const shown = frame.arms.learned || frame.arms.documented;
    if (frame.arms.learned) bones(frame.arms.learned, colors.accent, 2.6, 1);
    shown.joints.forEach((p, j) => {
      const tick = 0.035 * reach, axis = shown.axes[j];
      g.strokeStyle = g.fillStyle = colors[`j${j % 8 + 1}`];
      g.lineWidth = 1.5;
      stroke([p.map((v, k) => v - tick * axis[k]), p.map((v, k) => v + tick * axis[k])]);
      const [a, b] = at(p), loud = frame.contact === j;
      if (loud) g.fillStyle = colors.goal;
      g.beginPath();
      g.arc(a, b, loud ? 7 : 3.6, 0, 2 * Math.PI);
      g.fill();
    });
    drawForce(g, at, shown);
    const bar = 0.2 * scale;
    g.strokeStyle = g.fillStyle = colors.muted;
    g.lineWidth = 1;
    g.beginPath(); g.moveTo(8, h - 10); g.lineTo(8 + bar, h - 10); g.stroke();
    g.fillText("0.2 m", 14 + bar, h - 6);
    const hand = shown.tips.length ? shown.tips[shown.tips.length - 1] : shown.joints[shown.joints.length - 1];
    canvas.setAttribute("aria-label", `The arm; its hand is at x ${number(hand[0], 2)}, y ${number(hand[1], 2)}, z ${number(hand[2], 2)} m`);
  };

  // The force at the hand, where it is more than its own doubt.
  const drawForce = (g, at, arm) => {
    if (!frame.wrench || !frame.push_learned) return;
    const force = frame.wrench.slice(0, 3), std = frame.wrench_std.slice(0, 3);
    if (!force.every(some) || !force.some((f, k) => Math.abs(f) > 4 * std[k])) return;
    const from = arm.joints[arm.joints.length - 1], size = Math.hypot(...force);
    const long = Math.min(0.5 * size / 20, 0.35) * hello.reach_m / size;
    const to = from.map((v, k) => v + long * force[k]), [a, b] = at(from), [c, d] = at(to);
    g.strokeStyle = g.fillStyle = colors.goal;
    g.lineWidth = 2.2;
    g.setLineDash([5, 3]);
    g.beginPath(); g.moveTo(a, b); g.lineTo(c, d); g.stroke();
    g.setLineDash([]);
    g.fillText(`${number(size, 2)} N`, c + 6, d);
  };

  const arm = by("arm");
  let dragged = null;
  arm.addEventListener("pointerdown", (e) => { dragged = [e.clientX, e.clientY]; arm.setPointerCapture(e.pointerId); });
  arm.addEventListener("pointermove", (e) => {
    if (!dragged) return;
    turnBy(-0.5 * (e.clientX - dragged[0]), 0.4 * (e.clientY - dragged[1]));
    dragged = [e.clientX, e.clientY];
  });
  for (const over of ["pointerup", "pointercancel"]) arm.addEventListener(over, () => { dragged = null; });
  const turnBy = (turn, lift) => {
    view.turn += turn;
    view.lift = Math.max(-10, Math.min(90, view.lift + lift));
    drawArm();
  };
  arm.addEventListener("keydown", (e) => {
    const steps = { ArrowLeft: [8, 0], ArrowRight: [-8, 0], ArrowUp: [0, 6], ArrowDown: [0, -6] };
    if (e.key === "Home") { view.turn = -55; view.lift = 18; drawArm(); }
    else if (steps[e.key]) turnBy(...steps[e.key]);
    else return;
    e.preventDefault();
  });

  // ---- λ and θ of the chosen joint
  const panels = { lambda: [], theta: [], effects: [] };
  const buildEstimate = () => {
    const choice = by("choice");
    choice.replaceChildren(choice.firstElementChild);
    hello.joints.forEach((name, j) => {
      const label = make("label"), input = make("input");
      input.type = "radio";
      input.name = "joint";
      input.checked = j === chosen;
      input.addEventListener("change", () => { chosen = j; drawEstimate(); });
      label.append(input, name);
      choice.append(label);
    });
    const entries = { lambda: hello.lambda, theta: hello.theta, effects: hello.effects };
    for (const [id, list] of Object.entries(entries)) {
      by(id).replaceChildren();
      panels[id] = list.map(([name, unit]) => {
        const figure = make("figure"), caption = make("figcaption");
        const value = make("span"), canvas = make("canvas");
        canvas.setAttribute("role", "img");
        caption.append(make("b", name), value);
        figure.append(caption, canvas);
        by(id).append(figure);
        return { figure, value, canvas, name, unit };
      });
    }
    by("effects-title").hidden = !hello.effects.length;
  };

  const course = (panel, rows, goal, known) => {
    const last = rows[rows.length - 1];
    const doubtful = !known || !last || !some(last[1]);
    panel.figure.className = doubtful ? "dim" : "";
    const text = last ? measured(last[1], known ? last[2] : null, panel.unit) : "–";
    put(panel.value, text);
    panel.canvas.setAttribute("aria-label", `${panel.name}: ${text}`);
    const [g, w, h] = surface(panel.canvas);
    const seen = rows.filter((r) => some(r[1]));
    if (!seen.length) return;
    const start = Math.min(seen[0][0], 0), end = Math.max(seen[seen.length - 1][0], start + 1);
    const settled = seen.slice(Math.floor(0.4 * seen.length));  // a first guess would flatten the rest
    const now = seen[seen.length - 1], margin = known && some(now[2]) ? 2 * now[2] : 0;
    let low = Math.min(...settled.map((r) => r[1]), now[1] - margin);
    let high = Math.max(...settled.map((r) => r[1]), now[1] + margin);
    if (some(goal) && Math.abs(goal - now[1]) < 5 * (high - low + 1e-12)) { low = Math.min(low, goal); high = Math.max(high, goal); }
    const least = Math.max(1e-3 * Math.max(Math.abs(low), Math.abs(high)), 1e-6);
    if (high - low < least) { const middle = (high + low) / 2; low = middle - least / 2; high = middle + least / 2; }
    const pad = 0.12 * (high - low);
    const x = (t) => w * (t - start) / (end - start);
    const y = (v) => Math.max(-h, Math.min(2 * h, h - h * (v - low + pad) / (high - low + 2 * pad)));
    g.strokeStyle = colors.grid;
    g.beginPath(); g.moveTo(0, h - 0.5); g.lineTo(w, h - 0.5); g.stroke();
    if (known) {
      g.fillStyle = colors.wash;
      const bands = seen.filter((r) => some(r[2])).map((r) => [r[0], r[1] - 2 * r[2], r[1] + 2 * r[2]]);
      if (bands.length > 1) band(g, bands, x, y);
    }
    if (some(goal)) {
      g.strokeStyle = colors.goal;
      g.setLineDash([4, 3]);
      g.beginPath(); g.moveTo(0, y(goal)); g.lineTo(w, y(goal)); g.stroke();
      g.setLineDash([]);
    }
    g.strokeStyle = colors[`j${chosen % 8 + 1}`];
    g.lineWidth = 1.4;
    g.beginPath();
    seen.forEach((r, k) => { if (k) g.lineTo(x(r[0]), y(r[1])); else g.moveTo(x(r[0]), y(r[1])); });
    g.stroke();
    g.fillStyle = colors.muted;
    g.strokeStyle = colors.card;  // around the figures, or curves strike them through
    g.lineWidth = 4;
    const decimals = Math.min(Math.max(0, 1 - Math.floor(Math.log10(high - low))), 7);  // two labels, two texts
    for (const [value, at] of [[high, 11], [low, h - 4]]) {
      const text = value.toFixed(decimals).replace("-", "−");
      g.strokeText(text, 3, at);
      g.fillText(text, 3, at);
    }
  };

  const drawEstimate = () => {
    if (!hello) return;
    const j = chosen, parent = hello.parents[j] < 0 ? "the base" : hello.links[hello.parents[j]];
    put(by("lam-title"), `λ: where ${hello.joints[j]} sits in ${parent}, against the documentation`);
    put(by("theta-title"), `θ: inertial parameters of ${hello.links[j]}`);
    const last = estimates[estimates.length - 1];
    panels.lambda.forEach((panel, k) => {
      const rows = estimates.map((e) => [e.t, e.off[j][k], e.off_std[j][k]]);
      course(panel, rows, 0, last && !last.hidden[j][k]);
    });
    panels.theta.forEach((panel, k) => {
      const rows = estimates.map((e) => [e.t, e.theta[j][k], e.theta_std[j][k]]);
      course(panel, rows, hello.theta_documented[j][k], hello.theta_alone[j][k]);
    });
    panels.effects.forEach((panel, k) => {
      const rows = estimates.map((e) => [e.t, e.effects[k][j], e.effects_std[k][j]]);
      course(panel, rows, null, frame && frame.theta !== "waiting");
    });
  };

  // ---- words and tables
  const tile = (id, value, note, kind = "") => {
    const [main, small] = by(id).querySelector("dd").children;
    put(main, value);
    put(small, note);
    by(id).className = `tile ${kind}`;
  };

  const most = (values) => Math.max(0, ...values.filter(some));

  const drawWords = () => {
    if (!frame) return;
    put(by("headline"), frame.headline);
    const at = Math.min(frame.t, hello.duration_s || Infinity).toFixed(1);  // what comes after the end is of its stop
    put(by("clock"), hello.duration_s ? `${at} s of ${number(hello.duration_s)} s` : `${at} s`);
    by("progress").style.width = hello.duration_s ? `${Math.min(100, 100 * frame.t / hello.duration_s)}%` : "0";
    document.title = `${hello.robot}: ${frame.headline}`;
    const last = estimates[estimates.length - 1];
    const open = (part) => last.off.flatMap((row, j) => row.slice(...part).map((v, k) => last.hidden[j][k + part[0]] ? 0 : Math.abs(v)));
    const within = (x) => (x < 0.001 ? "0.001" : number(x, 2));
    const far = last ? `within ${within(most(open([0, 3])))} mrad and ${within(most(open([3, 6])))} mm of the documentation` : "";
    tile("tile-lam", frame.lam, far, frame.lam === "converged" ? "good" : "");
    const ratio = most(frame.rms.map((v, j) => v / frame.noise[j]));
    tile("tile-theta", frame.theta === "waiting" ? "waits for λ" : frame.theta,
      ratio ? `torques explained to ${number(ratio, 2)} times the noise` : "", frame.theta === "converged" ? "good" : "");
    const load = news && news.load;
    tile("tile-load", load ? measured(load.m, load.m_std, "kg") : "none noticed",
      load ? `since ${number(load.since_s)} s` : "what it carries from the start counts as the last link", load ? "good" : "");
    const j = frame.contact;
    const watched = frame.push ? (frame.push_learned ? "against the learned model" : "against the documented model, coarse") : "nobody watches for contacts";
    tile("tile-contact", some(j) ? `${signed(frame.push[j], 3)} N m` : "none",
      some(j) ? `on ${hello.joints[j]}, ± ${number(frame.push_std[j], 2)} N m without a contact` : watched, some(j) ? "loud" : "");
    const loop = timing && timing.loop_us;
    tile("tile-loop", loop && some(loop.p99_lately) ? `${number(loop.p99_lately, 3)} µs` : "–",
      timing ? `p99 of the last 5 s; ${count(timing.missed)} deadlines missed` : "", timing && timing.missed_lately > 0 ? "loud" : "");
    put(by("foot"), `${count(frame.samples)} samples, ${count(frame.learned)} learned, ${count(frame.waiting)} wait` +
      (news && news.refused ? `, ${count(news.refused)} refused` : "") + ".");
    drawHand();
  };

  const drawHand = () => {
    const body = by("hand").tBodies[0], rows = [["force, N", 0], ["moment, N m", 3]];
    if (body.rows.length !== rows.length) {
      body.replaceChildren(...rows.map(([name]) => {
        const row = make("tr");
        row.append(make("td", name), make("td"), make("td"), make("td"));
        return row;
      }));
    }
    rows.forEach(([, at], r) => {
      for (let k = 0; k < 3; k++) {
        const value = frame.wrench ? frame.wrench[at + k] : null, std = frame.wrench ? frame.wrench_std[at + k] : null;
        const shown = some(value) && some(std) ? `${value.toFixed(at ? 2 : 1)} ±\u00a0${std.toFixed(at ? 2 : 1)}`.replace("-", "−") : "–";
        put(body.rows[r].cells[k + 1], shown);
      }
    });
  };

  const drawNews = () => {
    if (!news) return;
    const list = by("findings"), items = [];
    for (const found of [...news.findings].reverse()) {
      const item = make("li", undefined, found.over_s === null ? "" : "over");
      const where = found.joints.length ? ` on ${found.joints.map((j) => hello.joints[j - 1]).join(", ")}` : " at the hand";
      const size = found.size.map(([key, value, unit]) => `${key} ${number(value)} ${unit}`.trim()).join(", ");
      const until = found.over_s === null ? "" : ` to ${found.over_s.toFixed(2)} s`;
      const or = found.or.length ? ` (or ${found.or.join(" or ")})` : "";
      item.append(make("b", `${found.title}${or}`), `${where}, from ${found.since_s.toFixed(2)} s${until || " on"}`);
      item.append(make("small", [size, `seen at ${found.reported_s.toFixed(2)} s`].filter(Boolean).join("; ")));
      items.push(item);
    }
    for (const line of [...news.notes, ...news.lines]) items.push(make("li", line));
    list.replaceChildren(...(items.length ? items : [make("li", "Nothing new so far.")]));
  };

  const drawTiming = () => {
    if (!timing) return;
    const body = by("timing").tBodies[0];
    const names = { loop_us: "compute of a tick", lateness_us: "begin after its deadline" };
    body.replaceChildren(...Object.entries(names).filter(([key]) => timing[key].count).map(([key, name]) => {
      const row = make("tr"), t = timing[key];
      row.append(make("td", name), ...[t.p50_lately, t.p99_lately, t.p50, t.p99, t.max].map((v) => make("td", number(v, 3))));
      return row;
    }));
    put(by("timing-note"), `${count(timing.loop_us.count)} ticks; ${count(timing.missed)} deadlines missed, ` +
      `${count(timing.missed_own)} of them by the loop's own work.`);
  };

  const drawBadge = () => {
    const badge = by("badge"), age = (performance.now() - heard) / 1000;
    let [text, kind] = connected ? ["live", ""] : ["connection lost, trying again", "lost"];
    if (frame && frame.ended) [text, kind] = frame.ended[1] ? ["failed", "fault"] : ["ended", "over"];
    else if (frame && frame.done) [text, kind] = ["ended", "over"];
    else if (connected && frame && age > STALE_S) [text, kind] = [`no news for ${Math.round(age)} s`, "lost"];
    else if (!frame && !connected) text = heard ? text : "connecting";
    put(badge, text);
    badge.className = `badge ${kind}`;
  };

  const drawAll = () => {
    if (!hello) return;
    drawWords(); drawResiduals(); drawArm(); drawEstimate(); drawNews(); drawTiming(); drawBadge();
  };

  // ---- what comes in
  const begin = (message) => {
    const same = hello && hello.key === message.key;
    hello = message;
    hello.joints = shortened(hello.joints);
    hello.links = shortened(hello.links);
    if (same) return;
    frame = news = timing = null;
    frames = [];
    estimates = [];
    chosen = hello.joints.length - 1;
    put(by("who"), `${hello.robot} · ${hello.driver}`);
    buildResiduals();
    buildEstimate();
    drawNews();
  };
  const keep = (list, item, most) => {
    if (list.length && item.t < list[list.length - 1].t) return;
    list.push(item);
    if (list.length > most) list.splice(0, list.length - most);
  };
  const take = {
    hello: begin,
    history: (m) => {
      if (!frames.length) frames = m.frames;
      if (!estimates.length) estimates = m.estimates;
    },
    frame: (m) => {
      frame = m;
      keep(frames, { t: m.t, residual: m.residual, noise: m.noise }, FAST + 50);
    },
    estimate: (m) => {
      keep(estimates, m, SLOW * 4);
      if (estimates.length >= SLOW * 4) estimates = estimates.filter((_, k) => k % 2 === 0);
    },
    news: (m) => { news = m; drawNews(); },
    timing: (m) => { timing = m; },
  };
  const rates = { arm: 33, words: 200, residuals: 200, estimate: 1000 };
  const draws = {
    arm: drawArm,
    words: () => { drawWords(); drawTiming(); drawBadge(); },
    residuals: drawResiduals,
    estimate: drawEstimate,
  };
  const drawn = {};
  let asked = false, later = 0;
  // Each picture at its own rate; one that is not due yet is drawn later, also if nothing more comes.
  const draw = (now) => {
    asked = false;
    if (!hello) return;
    let left = false;
    for (const [what, rate] of Object.entries(rates)) {
      if (now - (drawn[what] ?? -Infinity) < rate) { left = true; continue; }
      drawn[what] = now;
      draws[what]();
    }
    if (left && !later) later = setTimeout(() => { later = 0; ask(); }, 250);
  };
  const ask = () => {
    if (asked || document.hidden) return;
    asked = true;
    requestAnimationFrame(draw);
  };

  let wait = 500;
  const connect = () => {
    const source = new EventSource("events");
    source.onopen = () => { connected = true; wait = 500; };
    source.onerror = () => {
      source.close();
      connected = false;
      drawBadge();
      setTimeout(connect, wait);
      wait = Math.min(1.6 * wait, 8000);
    };
    for (const [kind, use] of Object.entries(take)) {
      source.addEventListener(kind, (event) => {
        heard = performance.now();
        use(JSON.parse(event.data));
        if (kind === "frame" && frame.done) drawAll(); else ask();
      });
    }
  };
  setInterval(drawBadge, 1000);
  addEventListener("resize", drawAll);
  document.addEventListener("visibilitychange", () => { if (!document.hidden) drawAll(); });
  connect();
})();
