"""Every error code, with its meaning, its usual cause and its remedy.

The codes are stable words: users search for them, scripts compare them, and tests assert them.
`docs/reference/errors.md` is made of this file by `make schemas`. Nothing else imports it, so it costs no time at the
start of a program.

A command prints the code in brackets at the end of the first line of an error. The words on the wire, for faults and
refusals, are explained in `fault_codes`.
"""

from typing import NamedTuple


class ErrorCode(NamedTuple):
    """What a code means, in plain sentences."""

    title: str
    cause: str
    remedy: str
    # A page below docs/ with the steps of the remedy; empty if the remedy is complete.
    page: str = ""


ERROR_CODES = {
    # --- settings and files
    "config/invalid-value": ErrorCode(
        "A setting has a value that is not allowed.",
        "The value has the wrong type, or is not one of the allowed words.",
        "Change the setting to a value that the message names.",
    ),
    "config/out-of-range": ErrorCode(
        "A number is outside its limits.",
        "A number in a file or in `--set` is too small or too large, often because of its unit.",
        "Use SI units, and stay within the range that the message names.",
    ),
    "config/unknown-key": ErrorCode(
        "A setting does not exist.",
        "A key in a file or in `--set` is misspelled, or is in the wrong section.",
        "Use the key that the message suggests.",
    ),
    "config/missing-key": ErrorCode(
        "A required setting is missing.",
        "A key without a default is missing in a file, or a setting needs another setting.",
        "Add the key that the message names.",
    ),
    "config/conflict": ErrorCode(
        "Two settings contradict each other.",
        "Each value is allowed, but not together with the other one.",
        "Change or remove one of the settings that the message names.",
    ),
    "config/duplicate-name": ErrorCode(
        "Two things have the same name.",
        "Obstacles of a scene, or conditions of a suite, must have different names.",
        "Rename one of them.",
    ),
    "config/unknown-name": ErrorCode(
        "No scenario, robot, scene, policy or joint has this name.",
        "The name is misspelled, or a path was meant and has no `/` and no ending.",
        "Use a name that the message lists, or give the path of a file, such as `./my_robot.toml`.",
    ),
    "file/not-found": ErrorCode(
        "A file does not exist.",
        "The path is wrong, or is relative to another folder.",
        "Check the path. Paths in a file are relative to the folder of that file.",
    ),
    "file/not-readable": ErrorCode(
        "A file exists, but cannot be used.",
        "Permissions are missing, the path is a folder, or the file holds something else than expected.",
        "Correct the permissions, or name another file.",
    ),
    "file/invalid-syntax": ErrorCode(
        "A file is not valid TOML, JSON or UTF-8 text.",
        "A typing error, or a file saved by a program in another encoding.",
        "Correct the line that the message names, and save the file as UTF-8.",
    ),
    "file/too-large": ErrorCode(
        "A file is larger or deeper nested than allowed.",
        "A data file was given instead of a settings file, or a generated file is too large.",
        "Check that the right file is named, and make it smaller.",
    ),
    "file/not-writable": ErrorCode(
        "A file or folder cannot be written.",
        "The disk is full or read-only, permissions are missing, or a folder in the path is a file.",
        "Free some space, or choose another place.",
    ),
    "file/already-exists": ErrorCode(
        "The output exists already, and is never overwritten.",
        "An earlier command wrote to the same place.",
        "Choose another place, remove the old output, or continue it with `--resume` where that exists.",
    ),
    "file/in-use": ErrorCode(
        "Another process writes to this folder.",
        "Two runs or evaluations have the same `--out`.",
        "Choose another folder, or end the other process.",
    ),
    # --- commands and the Python API
    "command/unknown-command": ErrorCode(
        "There is no such command.",
        "The name is misspelled, or the package that adds the command is not installed.",
        "Run `snakesim` alone to list all commands.",
    ),
    "command/unknown-argument": ErrorCode(
        "The command has no such argument or option.",
        "The option is misspelled, or belongs to another command.",
        "Run the command with --help.",
    ),
    "command/invalid-option": ErrorCode(
        "An option has a value that is not allowed.",
        "The value is empty, has the wrong form, or is outside its range.",
        "Give the option as the example in the message shows.",
    ),
    "command/conflicting-options": ErrorCode(
        "Two options exclude each other, or one option needs another.",
        "They were given together, or one of them is missing.",
        "Leave out or add the option that the message names.",
    ),
    "python/invalid-argument": ErrorCode(
        "A function of the Python API got an argument that is not allowed.",
        "A wrong type, a wrong number of values, or an object where a class is needed.",
        "Pass what the message names. See docs/how-to/python.md and docs/how-to/environments.md.",
    ),
    # --- plug-ins and extras
    "extra/not-installed": ErrorCode(
        "An optional package is not installed.",
        "The command needs an extra, such as `snakesim[record]`.",
        "Run the `pip install` command in the message.",
        page="troubleshooting/extra-not-installed.md",
    ),
    "plugin/not-found": ErrorCode(
        "No controller, service, backend or sensor model has this name.",
        "The name is misspelled, its package is not installed, or the file has no such class.",
        "Use an installed name, or give a file and a class, such as `./wave.py:Wave`.",
    ),
    "plugin/ambiguous": ErrorCode(
        "Several installed packages have a plug-in of this name.",
        "Two packages declare the same entry point.",
        "Uninstall all but one, or name a file and a class.",
    ),
    "plugin/not-loadable": ErrorCode(
        "A plug-in was found, but cannot be used.",
        "Its module raises an exception when it is imported, or a required part of its class is missing.",
        "Correct the plug-in at the line that the message names.",
    ),
    # --- scenes
    "scene/invalid": ErrorCode(
        "A scene cannot be built as described.",
        "Too many obstacles, obstacles without size, or numbers that do not fit each other.",
        "Change the values that the message names.",
    ),
    "scene/overlap": ErrorCode(
        "An obstacle overlaps the robot at its start.",
        "The obstacle or the start pose is misplaced.",
        "Move the obstacle or the start.",
    ),
    "scene/no-route": ErrorCode(
        "A setting needs a route, and the scene has none.",
        "The scene file has no [route] section.",
        "Add a [route] section, or remove the setting that needs it.",
    ),
    # --- injected faults
    "injection/unknown-fault": ErrorCode(
        "A fault to inject is written wrongly, or does not exist.",
        "The kind is misspelled, the target cannot have this fault, or its amount is outside the range.",
        "Write it as the message shows. All kinds are in docs/how-to/inject-faults.md.",
    ),
    "injection/unknown-target": ErrorCode(
        "The target of a fault does not exist in this run.",
        "The robot has fewer joints or buses, or the run does not start that process.",
        "Use a target that the message lists.",
    ),
    "injection/not-supported": ErrorCode(
        "This fault cannot be injected here.",
        "The backend, the bus or the kind of run cannot produce it.",
        "Use another backend, or start the robot with `snakesim run`.",
    ),
    "injection/not-allowed": ErrorCode(
        "This robot does not allow injected faults.",
        "Something real moves, or the run was started without permission.",
        "Allow them explicitly, as the message explains. See docs/how-to/inject-faults.md.",
    ),
    # --- buses and drives
    "bus/not-available": ErrorCode(
        "The bus does not exist on this computer.",
        "The adapter is not plugged in, the interface is down, the kernel has no CAN, or no program is on a local bus.",
        "Run the command that the message names, and see `snakesim doctor`.",
        page="troubleshooting/no-can.md",
    ),
    "bus/invalid-channel": ErrorCode(
        "The channels of the buses are configured wrongly.",
        "A channel is malformed, is named twice, or does not fit the joints.",
        "Correct `channels`, `joints_per_channel` or `port`.",
    ),
    "bus/cannot-open": ErrorCode(
        "A bus cannot be opened.",
        "Another program uses it, or permissions are missing.",
        "End the other program, and add your user to the group of the device.",
    ),
    "bus/io-failed": ErrorCode(
        "Sending to, or receiving from, a bus failed.",
        "The adapter was unplugged, or the interface went down.",
        "Check the adapter and its cable, bring the interface up, and start the robot again.",
    ),
    "bus/overloaded": ErrorCode(
        "The robot's traffic does not fit on its bus.",
        "Too many joints, too high a `rate_hz`, or too low a bit rate.",
        "Use the rate that the message names, a faster bus, or more buses.",
    ),
    "bus/second-host": ErrorCode(
        "Another program commands the drives on this bus.",
        "A second HAL host or a vendor's tool is running.",
        "End it first. Nothing was sent.",
    ),
    "bus/not-virtual": ErrorCode(
        "Emulated drives and a real bus are mixed.",
        "Emulators were started on a real bus, or without the bus that they need.",
        "Use a virtual interface such as `vcan0` for emulators, and real channels for real drives.",
    ),
    "drive/not-complete": ErrorCode(
        "Not all drives of the robot answered correctly at the start.",
        "A drive has no power, a wrong id, a wrong bit rate, or wrong limits. The message lists each one.",
        "Correct the drives on the list. No drive was enabled.",
        page="troubleshooting/drive-silent.md",
    ),
    "drive/silent": ErrorCode(
        "A drive does not answer.",
        "Power, cable, id, bit rate or terminator.",
        "Check them for the joints that the message names.",
        page="troubleshooting/drive-silent.md",
    ),
    "drive/parameter-refused": ErrorCode(
        "A drive refuses a parameter.",
        "The value in the robot file is outside the range of the drive.",
        "Change the value in the robot file to the allowed range.",
    ),
    "drive/no-watchdog": ErrorCode(
        "The scenario does not accept that these drives have no watchdog.",
        "Their protocol has none: they hold their last angle if the host dies or the cable breaks.",
        "Put a relay of an emergency stop circuit into their supply, and set the key that the message names.",
    ),
    "drive/unsupported-setting": ErrorCode(
        "The robot file asks for something that this type of drive cannot do.",
        "A limit, id, gain, stop mode or travel is beyond the drive or its protocol.",
        "Change the setting that the message names, or use another drive.",
    ),
    "drive/unknown-type": ErrorCode(
        "The drive type of a joint is missing or does not exist.",
        "`driver` in the robot file is not set, is misspelled, or does not fit the backend.",
        "Set `driver` in [joints.NAME] or [drive].",
    ),
    "drive/watchdog-too-short": ErrorCode(
        "A drive's watchdog or decimation does not fit the rate.",
        "One lost setpoint would stop the drives, or joint states would be too old.",
        "Use the value that the message names.",
    ),
    "emulator/not-started": ErrorCode(
        "The emulated joint modules did not start.",
        "Their process failed. Its output is above the message.",
        "Correct the cause in that output.",
    ),
    # --- simulator and backends
    "simulator/cannot-build": ErrorCode(
        "MuJoCo cannot build this robot in this scene.",
        "Masses, inertias or sizes are not physically possible.",
        "Correct the value that MuJoCo names.",
    ),
    "simulator/diverged": ErrorCode(
        "The simulation diverged, and the run stopped.",
        "Gains are too high, contacts are too stiff, or the physics step is too long.",
        "Lower gains or stiffness, or use a shorter `timestep_s`.",
    ),
    "simulator/no-opengl": ErrorCode(
        "Images cannot be rendered on this computer.",
        "OpenGL by EGL or OSMesa is not installed.",
        "Install the packages that the message names, and see `snakesim doctor`.",
        page="troubleshooting/no-opengl.md",
    ),
    "backend/failed": ErrorCode(
        "The backend cannot continue.",
        "An exception in the backend, or a device that failed. The host stopped the robot.",
        "See the cause in the message and in host.log.",
    ),
    "backend/closed": ErrorCode(
        "A backend was used after it was closed.",
        "A program kept an object of a run that is over.",
        "Open a new backend.",
    ),
    "backend/step-timeout": ErrorCode(
        "A part of the control cycle did not return in time.",
        "Code of a backend, service or controller blocks, or the machine is too slow for it.",
        "Make the named line faster, or raise the limit that the message names.",
        page="troubleshooting/computer-too-slow.md",
    ),
    "backend/wrong-clock-mode": ErrorCode(
        "The backend cannot keep this clock mode.",
        "Real hardware runs in real time only. Runs in one process are in lockstep.",
        "Use a clock mode that the message names.",
    ),
    # --- network and certificates
    "network/no-robot": ErrorCode(
        "No robot was found at this endpoint and namespace.",
        "Its HAL host is not running, or has another namespace.",
        "Start the robot, and see `snakesim status`.",
        page="troubleshooting/no-robot.md",
    ),
    "network/several-robots": ErrorCode(
        "Several robots were found, and the command is for one.",
        "More than one robot is on the network.",
        "Choose one with --namespace.",
    ),
    "network/no-answer": ErrorCode(
        "A process of the robot does not answer.",
        "Its host hangs or has ended, the network is blocked, or your role may not send this request.",
        "See `snakesim status`. If the robot moves, run `snakesim estop`.",
    ),
    "network/nothing-listens": ErrorCode(
        "Nothing listens at this address.",
        "No run, router or scheduler was started there, or a firewall is between.",
        "Start it, or give another address.",
        page="troubleshooting/no-robot.md",
    ),
    "network/no-ticks": ErrorCode(
        "The robot's clock has stopped.",
        "Its HAL host hangs, has ended, or cannot be reached any more.",
        "See `snakesim status` and host.log.",
    ),
    "network/port-in-use": ErrorCode(
        "A port cannot be opened.",
        "Another run or program listens on it.",
        "Choose another port, or end that program.",
        page="troubleshooting/port-in-use.md",
    ),
    "network/invalid-address": ErrorCode(
        "An endpoint, address or namespace is malformed.",
        "The protocol, host or port is missing, or a character is not allowed.",
        "Write it as the example in the message shows.",
    ),
    "network/insecure-endpoint": ErrorCode(
        "The endpoint would let anyone on the network command the robot.",
        "It is not on loopback, and clients are not authenticated.",
        "Listen on loopback, use certificates (docs/how-to/lab.md), or accept the risk with --insecure.",
    ),
    "network/loopback-down": ErrorCode(
        "The loopback interface is down.",
        "A container or network namespace was started without it.",
        "Run `ip link set lo up` there.",
    ),
    "network/session-file": ErrorCode(
        "A session or router file is not usable.",
        "A setting is missing, or makes the session something else than a client.",
        "Set the key that the message names. How to generate correct files is in docs/how-to/lab.md.",
    ),
    "network/unknown-key": ErrorCode(
        "There is no such key on the network.",
        "The key is misspelled, or this robot does not have that sensor.",
        "See schemas/keys.md.",
    ),
    "certificate/rejected": ErrorCode(
        "The router does not accept this certificate, or a certificate is missing.",
        "It is of another authority, has expired, or no router runs at that address.",
        "Install the files of the right authority (docs/how-to/lab.md), and set RUST_LOG=zenoh=warn to see why.",
        page="troubleshooting/certificate-rejected.md",
    ),
    "certificate/expired": ErrorCode(
        "The certificate authority has expired.",
        "It is older than its period of validity.",
        "Make a new authority, and install the new files on every machine. See docs/how-to/lab.md.",
        page="troubleshooting/certificate-rejected.md",
    ),
    "certificate/invalid-authority": ErrorCode(
        "The folder of the certificate authority cannot be trusted or read.",
        "Other users can read it, a file is missing, or key and certificate do not belong together.",
        "Restore the files, or make a new authority in a new folder.",
    ),
    # --- the state of the robot
    "robot/not-armed": ErrorCode(
        "The robot is not armed any more.",
        "A fault, an emergency stop, or another operator disarmed it.",
        "See `snakesim status` for the reason, remove the cause, then clear and arm.",
        page="troubleshooting/not-armed.md",
    ),
    "robot/not-ready": ErrorCode(
        "The robot cannot be armed now.",
        "A condition for arming is not met. The message lists what is missing.",
        "Correct it, and arm again.",
        page="troubleshooting/not-armed.md",
    ),
    "robot/not-running": ErrorCode(
        "The robot's host ended before the command could connect to it.",
        "The host could not start, or its drives did not answer. The last lines of the host are in the message.",
        "Correct what these lines name, and run the command again.",
    ),
    "robot/not-disarmed": ErrorCode(
        "The robot must be disarmed for this.",
        "It is armed, or stopped by a fault.",
        "Disarm it, or clear the fault, first.",
    ),
    "robot/has-controller": ErrorCode(
        "The robot has a controller already.",
        "Its run starts a control service, which holds the lease.",
        "Start it with --set services.control.external=true.",
    ),
    "robot/lease-lost": ErrorCode(
        "This process may not command the robot any more.",
        "Its commands came too late, or another process took the lease.",
        "Acquire the lease again. If this repeats, send commands faster.",
        page="troubleshooting/lease-expired.md",
    ),
    "robot/request-refused": ErrorCode(
        "The robot refused a request.",
        "The message has the reason of the host.",
        "Correct what the reason names. See also `snakesim status`.",
        page="troubleshooting/not-armed.md",
    ),
    "robot/not-confirmed": ErrorCode(
        "A request was sent, and the robot's status does not confirm it.",
        "The answer was lost, or two hosts answer for one robot.",
        "Look at the robot. Repeat the command, and use the emergency stop in doubt.",
    ),
    "robot/wrong-robot": ErrorCode(
        "The request to arm names another robot or backend.",
        "The command is for another machine, or for a simulated robot.",
        "Name robot and backend as the message shows.",
    ),
    "robot/several-hosts": ErrorCode(
        "Several hosts claim to be this robot.",
        "A host was started twice, or a client imitates it.",
        "End all but one. The robot was not armed.",
    ),
    "robot/already-running": ErrorCode(
        "A robot of this name is running already.",
        "An earlier run was not ended.",
        "End it, or give this one another --namespace or --endpoint.",
    ),
    "robot/real-hardware": ErrorCode(
        "This function is for simulated robots only.",
        "The backend moves real hardware.",
        "Use `snakesim run`, or a simulated backend.",
    ),
    # --- controllers and services
    "controller/failed": ErrorCode(
        "A controller raised an exception, or returned an invalid command.",
        "The message names the controller, the field and the value.",
        "Correct the controller at the line that the message names.",
    ),
    "controller/unknown-parameter": ErrorCode(
        "A controller does not accept a parameter.",
        "The name is misspelled, or the value is not allowed while it runs.",
        "Use a parameter that the message lists.",
    ),
    "policy/invalid": ErrorCode(
        "A policy does not fit this robot or this version.",
        "The ONNX file has other inputs, outputs or metadata than expected.",
        "Export it again, or correct its metadata. See docs/tutorials/train-a-policy.md.",
    ),
    "service/failed": ErrorCode(
        "A service raised an exception, or published an invalid message.",
        "The message names the service, the key, the field and the value.",
        "Correct the service at the line that the message names.",
    ),
    "message/rejected": ErrorCode(
        "A message is malformed, out of bounds, or of an unknown version.",
        "Sender and receiver have different versions, or a value is outside the range of its field.",
        "Compare the field that the message names with schemas/messages.",
    ),
    # --- runs and recordings
    "run/failed": ErrorCode(
        "A process of the run ended early.",
        "Its output is above the message, or in its log in the folder of the run.",
        "Correct the cause in that output, and run again.",
    ),
    "recording/incomplete": ErrorCode(
        "A record is used although data is missing in it (exit code 3).",
        "Samples were lost, the file was cut off, or numbers are invalid.",
        "Check the result, or record again. The message lists what is missing.",
        page="troubleshooting/recording-incomplete.md",
    ),
    "recording/not-a-run": ErrorCode(
        "The folder does not hold a run.",
        "The path is wrong, or the run was never started.",
        "Give the folder that `snakesim run` left.",
    ),
    "recording/not-readable": ErrorCode(
        "A recording is damaged, or is a file of another kind.",
        "The file was cut off or changed, or its name is wrong.",
        "Name another file, or recover what is readable. See docs/how-to/recordings.md.",
        page="troubleshooting/recording-incomplete.md",
    ),
    "recording/missing-data": ErrorCode(
        "A recording does not hold what this command needs.",
        "The robot lacked a sensor or a controller, or a key was not recorded.",
        "Record a run that has it.",
    ),
    "recording/never-armed": ErrorCode(
        "Nothing was recorded, because the robot was never armed.",
        "A condition for arming was not met.",
        "See host.log in the folder, and run again.",
    ),
    "recording/not-comparable": ErrorCode(
        "Runs do not fit each other.",
        "They are of different robots or rates, or have no common measure.",
        "Compare runs of one robot file.",
    ),
    "recording/unknown-signal": ErrorCode(
        "A run has no such signal.",
        "The name is misspelled, or the robot does not have the sensor.",
        "Use a signal that the message lists.",
    ),
    "recording/untrusted-code": ErrorCode(
        "The recording asks to run a Python file.",
        "It was made with a controller from a file, which the recording only names.",
        "If you trust the file, name it yourself, as the message shows.",
    ),
    # --- further tools
    "evaluation/other-search": ErrorCode(
        "The file or folder holds another search.",
        "Values, seeds or version differ, so that the results are not comparable.",
        "Repeat the original command, or choose another file.",
    ),
    "lab/invalid-file": ErrorCode(
        "A lab file contradicts itself.",
        "A robot, machine, router or bus is missing or is used twice.",
        "Correct the entry that the message names. See docs/how-to/lab.md.",
    ),
    "urdf/invalid": ErrorCode(
        "A URDF file or a mesh cannot be imported.",
        "It is not valid, or describes something that is not a chain of joints.",
        "Correct the line that the message names.",
    ),
    "commissioning/not-possible": ErrorCode(
        "A commissioning step cannot be done now.",
        "The robot moves, an angle is unknown, or file and record do not fit each other.",
        "Follow the message, then repeat the step.",
        page="troubleshooting/calibration-missing.md",
    ),
    "machine/not-permitted": ErrorCode(
        "The operating system does not permit this.",
        "A capability, such as CAP_NET_ADMIN or CAP_SYS_TIME, is missing.",
        "Run as root, or leave that part out.",
    ),
}
