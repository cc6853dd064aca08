// The attitude indicator. Old attitudes are grey; without an attitude, no horizon is drawn.

export function drawAttitude(canvas, attitude, isOld) {
  const ratio = window.devicePixelRatio || 1;
  const size = canvas.getBoundingClientRect().width;
  if (canvas.width !== Math.round(size * ratio)) canvas.width = canvas.height = Math.round(size * ratio);
  const pen = canvas.getContext("2d"), radius = size / 2 - 2;
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, size, size);
  pen.save();
  pen.translate(size / 2, size / 2);
  pen.beginPath();
  pen.arc(0, 0, radius, 0, 7);
  pen.clip();
  if (!attitude || typeof attitude.roll_deg !== "number" || typeof attitude.pitch_deg !== "number") {
    const style = getComputedStyle(canvas);
    pen.fillStyle = style.getPropertyValue("--no-attitude");
    pen.fillRect(-radius, -radius, 2 * radius, 2 * radius);
    pen.fillStyle = style.getPropertyValue("--dim");
    pen.font = "22px system-ui, sans-serif";
    pen.textAlign = "center";
    pen.fillText("—", 0, 7);
    pen.restore();
    return;
  }
  drawHorizon(pen, attitude, radius, isOld);
  pen.restore();
  drawFrame(pen, size, radius, isOld);
}

function drawHorizon(pen, attitude, radius, isOld) {
  const perDegree = radius / 45;
  pen.rotate(-attitude.roll_deg * Math.PI / 180);
  const horizon = attitude.pitch_deg * perDegree;
  pen.fillStyle = isOld ? "#39424e" : "#2b79b8";
  pen.fillRect(-2 * radius, -6 * radius, 4 * radius, 6 * radius + horizon);
  pen.fillStyle = isOld ? "#2a2d31" : "#80562c";
  pen.fillRect(-2 * radius, horizon, 4 * radius, 6 * radius);
  pen.strokeStyle = pen.fillStyle = "#fff";
  pen.lineWidth = 1.5;
  pen.font = "9px system-ui, sans-serif";
  pen.textAlign = "left";
  for (let degrees = -90; degrees <= 90; degrees += 10) {
    const y = horizon - degrees * perDegree, half = degrees === 0 ? 2 * radius : degrees % 20 ? 9 : 18;
    if (Math.abs(y) > radius * 0.8 && degrees) continue;
    pen.beginPath();
    pen.moveTo(-half, y);
    pen.lineTo(half, y);
    pen.stroke();
    if (degrees && degrees % 20 === 0) pen.fillText(String(Math.abs(degrees)), half + 3, y + 3);
  }
  pen.beginPath();
  pen.moveTo(0, -radius + 3);
  pen.lineTo(-5, -radius + 13);
  pen.lineTo(5, -radius + 13);
  pen.fill();
}

function drawFrame(pen, size, radius, isOld) {
  pen.save();
  pen.translate(size / 2, size / 2);
  pen.strokeStyle = "#c9d6e6";
  for (const degrees of [-60, -45, -30, -20, -10, 0, 10, 20, 30, 45, 60]) {
    pen.save();
    pen.rotate(degrees * Math.PI / 180);
    pen.beginPath();
    pen.moveTo(0, -radius);
    pen.lineTo(0, -radius + (degrees % 30 ? 4 : 7));
    pen.stroke();
    pen.restore();
  }
  pen.lineWidth = 3;
  pen.strokeStyle = isOld ? "#8fa0b5" : "#ffd23f";
  pen.beginPath();
  pen.moveTo(-radius * 0.55, 0);
  pen.lineTo(-radius * 0.2, 0);
  pen.lineTo(0, radius * 0.13);
  pen.lineTo(radius * 0.2, 0);
  pen.lineTo(radius * 0.55, 0);
  pen.stroke();
  pen.lineWidth = 2;
  pen.strokeStyle = "#253041";
  pen.beginPath();
  pen.arc(0, 0, radius, 0, 7);
  pen.stroke();
  pen.restore();
}
