// Closure sensor: two analogue inputs, one line for each pair of readings, 200 lines a second.
//
// Wiring: one potentiometer or Hall sensor with analogue output per forceps, left on A0, right on A1, supplied from the
// board's own reference, so that its voltage cancels out of the readings.
//
// A line is  C,<seq>,<micros>,<left>,<right>*<XX>  and a newline. XX is the exclusive or of all bytes from C to the one
// before the star, as two hexadecimal digits: the host drops any line where it does not match.

const uint8_t LEFT_PIN = A0;
const uint8_t RIGHT_PIN = A1;
const uint32_t PERIOD_US = 5000;

uint32_t sequence = 0;
uint32_t due = 0;

void setup() {
  Serial.begin(115200);
  Serial.println(F("closure sensor 1, 200 Hz"));
  due = micros();
}

void loop() {
  // The difference is signed on purpose: micros() starts again from 0 after 71 minutes.
  if ((int32_t)(micros() - due) < 0) return;
  due += PERIOD_US;

  char line[48];
  const uint32_t now = micros();
  const int left = analogRead(LEFT_PIN);
  const int right = analogRead(RIGHT_PIN);
  const int length = snprintf(line, sizeof line, "C,%lu,%lu,%d,%d", (unsigned long)sequence++, (unsigned long)now, left, right);

  uint8_t check = 0;
  for (int i = 0; i < length; i++) check ^= (uint8_t)line[i];

  char tail[8];
  snprintf(tail, sizeof tail, "*%02X\n", check);
  Serial.print(line);
  Serial.print(tail);
}
