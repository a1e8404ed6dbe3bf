"""What models of published hands are like, each trait in a small hand of two fingers."""

import math
from pathlib import Path

import numpy as np
import pytest
from tactilerl.envs import hands, layouts, scripted
from tactilerl.envs.grasp import GraspEnv, setup
from tactilerl.envs.hands import model_file

TIP = '<geom type="capsule" size="0.008" fromto="0 0 0 0.03 0 0"/>'
FINGER = """<body name="{n}_1" pos="{x} 0 -0.02" euler="0 1.5708 0">
<joint name="{n}_a" axis="0 {s} 0" range="0 1.5" armature="0.005" damping="0.3"/>
<geom type="capsule" size="0.008" fromto="0 0 0 0.05 0 0"/>
<body name="{n}_2" pos="0.05 0 0"><joint name="{n}_b" axis="0 {s} 0" range="0 1.5" armature="0.005"
damping="0.3"/>{tip}</body></body>
"""


def fingers(tip=TIP):
    """With something else at their ends, where {n} is the finger."""
    sides = ("l", -1), ("r", 1)
    return "".join(FINGER.format(n=n, x=0.05 * s, s=s, tip=tip.format(n=n)) for n, s in sides)


FINGERS = fingers()
PALM = '<geom type="box" size="0.06 0.03 0.015"/>'
MODEL = f"""<mujoco><compiler angle="radian"/><worldbody>
<body name="palm" pos="0 0 0.3">{PALM}{FINGERS}</body></worldbody></mujoco>"""
TOML = (Path(__file__).parents[1] / "hands/two_fingers.toml").read_text()
FOLLOWERS = TOML.replace('"?_b" = 0.3\n', "")


def with_more(*sections):
    """The model with further sections at its end."""
    return MODEL.replace("</mujoco>", f"{''.join(sections)}</mujoco>")


def servos(*each):
    return f"<actuator>{''.join(each)}</actuator>"


def coupled(law, joint="b", driver="a"):
    law = f'joint1="{{n}}_{joint}" joint2="{{n}}_{driver}" polycoef="{law} 0 0"'
    return f"<equality>{''.join(f'<joint {law.format(n=n)}/>' for n in 'lr')}</equality>"


def on_palm(more):
    return MODEL.replace(PALM, PALM + more)


BOTH = "mujoco", "pybullet"
ALL = [f'<position name="{j}" joint="{j}" kp="5"/>' for j in ("l_a", "l_b", "r_a", "r_b")]


@pytest.fixture
def made(tmp_path):
    """made(model, toml, name) is the path of a hand's file beside its model."""

    def make(model=MODEL, toml=TOML, name="hand.xml"):
        (tmp_path / name).write_text(model)
        (tmp_path / "hand.toml").write_text(toml.replace("hand.xml", name))
        return str(tmp_path / "hand.toml")

    return make


def made_env(path, simulator="mujoco", **choices):
    """At the start of an episode."""
    env = GraspEnv(path, setup(path, simulator=simulator, **{"layout": "5", **choices}))
    env.reset(seed=0)
    return env


def reached(env, targets, steps):
    """The joints' positions by name after some control steps."""
    for _ in range(steps):
        env.step_to(targets)
    return dict(zip(env.hand.joints, env.simulator.state().joint_positions.tolist(), strict=True))


def at_start(path, simulator="mujoco", steps=5):
    env = made_env(path, simulator)
    return reached(env, env.hand.start_targets(), steps)


def grasp(env):
    """The actions of the scripted grasp."""
    return scripted.legs(env, scripted.grasp_for(env), 0.05)[1]


class TestCouplings:
    @pytest.mark.parametrize("from_file", [False, True])
    def test_an_offset_is_kept_at_the_start_and_held(self, made, simulator, from_file):
        if from_file:
            rows = [f"{n}_b = {{follows = '{n}_a', ratio = 0.5, offset = 0.4}}\n" for n in "lr"]
            rows = "".join(["[couplings]\n", *rows, "[[grasp]]"])
            path = made(toml=FOLLOWERS.replace("[[grasp]]", rows))
        else:
            path = made(with_more(coupled("0.4 0.5 0")), FOLLOWERS)
        hand = hands.get(path)
        assert hand.couplings[0][:4] == ("l_b", "l_a", 0.5, 0.4)
        assert hand.start["l_b"] == 0.4
        assert "l_b" not in hand.actuated
        assert at_start(path, simulator)["l_b"] == pytest.approx(0.4, abs=0.02)

    def test_followers_follow_their_driver_under_load(self, made, simulator):
        env = made_env(made(with_more(coupled("0.3 0.8 0")), FOLLOWERS), simulator)
        *_, targets = grasp(env)
        found = reached(env, targets, 8)
        assert abs(found["l_a"] - 0.6) > 0.05  # something holds it up
        for n in "lr":
            assert found[f"{n}_b"] == pytest.approx(0.3 + 0.8 * found[f"{n}_a"], abs=0.02)

    def test_followers_stay_in_their_range(self, made, simulator):
        env = made_env(made(with_more(coupled("0.7 1 0")), FOLLOWERS), simulator)
        targets = env.hand.start_targets()
        targets[3:] = 1.5  # with which followers would be at 2.2
        positions = reached(env, targets, 8)
        assert 1.4 < positions["l_b"] < 1.52

    def test_the_joint_that_has_the_servo_drives(self, made):
        """Whichever of the two the equality names first."""
        hand = hands.get(made(with_more(coupled("-0.6 2 0", "a", "b"), servos(*ALL[::2])), FOLLOWERS))
        assert hand.actuated[3:] == ("l_a", "r_a")
        assert hand.couplings[0] == ("l_b", "l_a", 0.5, pytest.approx(0.3), True)

    @pytest.mark.pybullet
    def test_who_pushes_a_follower_pushes_its_driver(self, made):
        """So that fingers hold an object as hard in both simulators."""
        path, forces = made(with_more(coupled("0.3 0.8 0")), FOLLOWERS), []
        for simulator in BOTH:
            env = made_env(path, simulator)
            for targets in grasp(env):
                env.step_to(targets)
            forces.append(float(env.simulator.state().contacts.forces.sum()))
        assert forces[0] > 10
        assert forces[1] == pytest.approx(forces[0], rel=0.1)

    def test_followers_of_followers_follow_the_first(self, made):
        more = '<joint joint1="r_a" joint2="l_b" polycoef="0.1 2 0 0 0"/></equality>'
        model = with_more(coupled("0.3 0.5 0").replace("</equality>", more))
        hand = hands.get(made(model, FOLLOWERS.replace('"?_a"', "l_a")))
        assert {each.driver for each in hand.couplings} == {"l_a"}
        law = {each.joint: (each.ratio, each.offset) for each in hand.couplings}
        assert law["r_a"] == (1.0, pytest.approx(0.7))
        assert law["r_b"] == (0.5, pytest.approx(0.65))


GEARED = '<position name="l_a" joint="l_a" kp="5" gear="2"/>'
OWN_UNITS = '<general name="l_a" joint="l_a" biastype="affine" gainprm="0.02" biasprm="0 -5 0" ' \
            'ctrlrange="0 255"/>'  # fmt: skip


class TestServos:
    @pytest.mark.parametrize("servo", [GEARED, OWN_UNITS])
    def test_a_target_is_where_the_joint_goes_and_is_held_from_the_start(self, made, servo):
        toml = TOML.replace("[closed]", '[opened]\n"?_a" = 0.4\n[closed]')
        path = made(with_more(servos(servo, *ALL[1:])), toml)
        assert not hands.get(path).notes
        for steps in (1, 6):
            assert at_start(path, steps=steps)["l_a"] == pytest.approx(0.4, abs=0.025), steps

    def test_a_servo_on_a_tendon_is_one_action_of_its_joints(self, made):
        both = '<joint joint="l_a" coef="1"/><joint joint="l_b" coef="1"/>'
        tendon = f'<tendon><fixed name="t">{both}</fixed></tendon>'
        servo = '<position name="t" tendon="t" kp="5" ctrlrange="0 3"/>'
        toml = TOML.replace('"?_b"', "r_b").replace("[closed]", "[opened]\nl_a = 0.3\n[closed]")
        path = made(with_more(tendon, servos(servo, *ALL[2:])), toml)
        hand = hands.get(path)
        assert hand.actuated[3] == "l_a"
        assert hand.couplings == (("l_b", "l_a", 1.0, 0.0, False),)
        assert hand.action_map.centre[3] + hand.action_map.half_range[3] == pytest.approx(1.5)
        found = at_start(path)
        assert found["l_a"] + found["l_b"] == pytest.approx(0.6, abs=0.02)

    @pytest.mark.parametrize(
        "more",
        [
            ['<motor name="m" joint="l_a"/>'],
            [*ALL, '<position name="m" joint="l_a" kp="1"/>'],
            [*ALL[1:], '<pid name="m" joint="l_a" kp="1" ki="1"/>'],
            [*ALL[1:], '<position name="m" joint="l_a" kp="5" timeconst="0.5"/>'],
            [*ALL[1:], '<position name="m" joint="l_a" kp="1" gear="-1"/>'],
            [*ALL[1:], '<intvelocity name="m" joint="l_a" kp="1" actrange="0 1"/>'],
        ],
    )
    def test_what_is_no_set_of_position_servos_is_replaced_with_a_note(self, made, more):
        hand = hands.get(made(with_more(servos(*more))))
        assert len(hand.actuated) == 7
        assert hand.notes[0].startswith("joints have the library's servos, as these are ")
        assert hand.notes[0].endswith(": m")

    def test_a_servo_moves_a_joint_without_a_range(self, made, simulator):
        env = made_env(made(with_more(servos(*ALL)).replace(' range="0 1.5"', "")), simulator)
        assert [*env.hand.action_map.half_range[3:]] == pytest.approx([1.57] * 4)
        assert len(env.hand.notes) == 1
        targets = env.hand.start_targets()
        targets[3:] = 0.1
        assert [*reached(env, targets, 20).values()][3:] == pytest.approx([0.1] * 4, abs=0.02)

    def test_a_joint_has_no_more_force_than_it_bears(self, made):
        weak = 'range="0 1.5" actuatorfrcrange="-0.01 0.01"'
        env = made_env(made(with_more(servos(*ALL)).replace('range="0 1.5"', weak)), "pybullet")
        assert [*env.simulator._forces[3:]] == pytest.approx([0.01] * 4)

    def test_weak_servos_are_named(self, made):
        weak = [servo.replace('"5"', '"0.05"') for servo in ALL]
        (note,) = hands.get(made(with_more(servos(*weak)))).notes
        assert "4 of 4 servos are weak" in note
        assert "the weakest goes 1 % of its way; drop all servos" in note
        assert not hands.get(made(with_more(servos(*ALL)))).notes

    def test_a_joint_of_a_closed_loop_is_passive(self, made):
        shape = '<geom type="capsule" size="0.004" fromto="0 0 0 0.05 0 0"/>'
        joint = f'<joint name="bar" axis="0 1 0" range="-2 2"/>{shape}</body>'
        bar = f'<body name="bar" pos="0.05 0.02 -0.02" euler="0 1.5708 0">{joint}'
        loop = '<equality><connect body1="bar" body2="r_1" anchor="0.05 0 0"/></equality>'
        hand = hands.get(made(with_more(loop).replace(PALM, PALM + bar)))
        assert "bar" not in hand.actuated
        assert "bar" in hand.notes[0]
        hand = hands.get(made(toml='passive = ["r_b"]\n' + TOML.replace('"?_b"', "l_b")))
        assert "r_b" not in hand.actuated

    @pytest.mark.parametrize("more", ["", "</body><body name='other' pos='0.2 0 0.3'>" + PALM])
    def test_models_in_degrees(self, made, more):
        """Angles of the hand's file are rad all the same."""
        degrees = (("radian", "degree"), ("1.5708", "90"), ('range="0 1.5"', 'range="0 86" ref="20"'))
        model = with_more(coupled("0.1 0.5 0")).replace(FINGERS, FINGERS + more)
        for old, new in degrees:
            model = model.replace(old, new)
        hand = hands.get(made(model, FOLLOWERS + '[ranges]\n"?_a" = [-0.5, 1.0]\n'))
        assert model_file.compiled(hand.build()).joint("l_a").range == pytest.approx([-0.5, 1.0])
        assert hand.couplings[0].offset == pytest.approx(0.1 + 0.5 * math.radians(20))

    def test_what_stands_in_a_frame(self, made):
        model = MODEL.replace("<worldbody>", '<worldbody><frame pos="0.1 0 0.5" euler="1.5 0 0">')
        moved = made(model.replace("</worldbody>", "</frame></worldbody>"))
        tips = [made_env(path).simulator.state().fingertips for path in (made(), moved)]
        assert tips[1] == pytest.approx(tips[0], abs=1e-3)

    def test_a_wrist_at_the_root(self, made, simulator):
        wrist = '<joint name="wrist" axis="0 1 0" range="-0.5 0.5"/>'
        path = made(MODEL.replace(PALM, wrist + PALM))
        hand = hands.get(path)
        assert hand.joints[:4] == (*hands.SLIDES, "wrist")
        assert at_start(path, simulator)["wrist"] == pytest.approx(0.0, abs=0.02)

    def test_includes_beside_what_includes_them(self, made, tmp_path):
        """MuJoCo prefers what is beside the model."""
        (tmp_path / "in").mkdir()
        (tmp_path / "in/a.xml").write_text('<mujoco><include file="b.xml"/></mujoco>')
        path = made(with_more('<include file="in/a.xml"/>'))
        for place in ("in/b.xml", "b.xml"):
            (tmp_path / place).write_text("<mujoco><option/></mujoco>")
            hands._read.clear()
            assert tmp_path / place in hands.get(path).paths


UNLIMITED = MODEL.replace('axis="0 -1 0" range="0 1.5"', 'axis="0 -1 0"', 1)
BALL = '<body name="pad"><joint type="ball"/><geom size=".005"/></body>'
FREE = '</body><body name="ball"><freejoint/><geom size="0.1"/>'
UNMOVED = TOML.replace("[closed]", '[opened]\n"l_a" = 0.6\nl_b = 0.3\n[closed]')
FLAT = '<inertial pos="0 0 0" mass="0.03" diaginertia="1e-5 1e-5 3e-5"/>'
BALANCED = MODEL.replace("<compiler ", '<compiler balanceinertia="true" ')
UNNAMED = with_more(servos(*(servo.replace(f'name="{servo[16:19]}" ', "") for servo in ALL)))
MOVED = '<body name="ball" mocap="true"><geom size="0.02"/></body></worldbody>'
FLOOR = '<worldbody><geom name="floor" type="plane" size="1 1 .1" pos="0 0 0.08"/>'
PADS = fingers(f'<body name="{{n}}_tip">{TIP}</body>')
EXCLUDED = with_more('<contact><exclude body1="l_tip" body2="palm"/></contact>')
ONE_DIGIT = TOML.replace(TOML[TOML.index("index =") : TOML.index("[closed]")], "")
USUAL = {
    "a ball beside the hand": (MODEL.replace(FINGERS, FINGERS + FREE), TOML),
    "a ball that is moved from outside": (MODEL.replace("</worldbody>", MOVED), TOML),
    "balanced inertias": (BALANCED.replace(FINGERS, fingers(TIP + FLAT)), TOML),
    "actuators without names": (UNNAMED, TOML),
    "a floor": (MODEL.replace("<worldbody>", FLOOR), TOML),
    "excluded contacts of what is part of a link": (EXCLUDED.replace(FINGERS, PADS), TOML),
    "bodies without names": (MODEL.replace('name="l_1" ', ""), TOML.replace('"l_1", ', "")),
    "only one digit": (MODEL, ONE_DIGIT),
}
CIRCLE = '<joint joint1="l_a" joint2="l_b"/><joint joint1="l_b" joint2="l_a"/>'
CIRCLE = with_more(f"<equality>{CIRCLE}</equality>")
NO_HANDS = [
    (MODEL, TOML.replace("[0, 0, -1]", "[0, 0, 1]"), r"palmar: .* did you mean \[0\.0, 0\.0, -1"),
    (MODEL, TOML.replace('"?_b" = 0.3', '"?_b" = 9.0'), "closed.l_b: found 9, allowed 0 to 1.5"),
    (MODEL, UNMOVED, "digits.thumb: .*closed"),
    (with_more(coupled("0 1 0.2")), FOLLOWERS, r"'l_b' coupled to 'l_a' by \[0.2, 0.0, 0.0\] beyond"),
    (with_more(servos(ALL[2])), TOML.replace('"?_a" = 0.6\n', ""), "closed.l_b: .* drop all actuators"),
    (on_palm(BALL), TOML, "body 'pad': found ball joint '', allowed hinges"),
    (on_palm("<freejoint/>").replace(FINGERS, FINGERS + FREE), TOML, r"found 2 bodies at its root \("),
    (with_more('<equality><weld site1="a" site2="b"/></equality>'), TOML, "body of an equality: "),
    (CIRCLE, TOML.replace("?", "r"), "couplings: found a circle: l_a follows l_b"),
]


class TestModels:
    @pytest.mark.parametrize("what", USUAL)
    def test_a_hand_may_have(self, made, what):
        hand = hands.get(made(*USUAL[what]))
        assert not hand.notes
        assert hand.actuated[3:] == ("l_a", "l_b", "r_a", "r_b")
        built = hand.build()
        assert not {"ball", "floor"} & {part.name for part in (*built.bodies, *built.geoms)}

    def test_what_is_fixed_to_a_link_is_the_link(self, made):
        pad = f'<body name="{{n}}_tip" pos="0.01 0 0">{TIP}</body>'
        box = '<geom type="box" size="0.005 0.008 0.006" pos="0.005 0 0"/>'
        model = MODEL.replace(FINGERS, fingers(pad + box))
        for tip, link in (("[0.048, 0, 0]", "_2"), ("[0.038, 0, 0]", "_tip")):
            hand = hands.get(made(model, TOML.replace('_2"', f'{link}"').replace("[0.038, 0, 0]", tip)))
            assert hand.fingertips[0] == ("l_2", pytest.approx((0.048, 0, 0)))
            assert len(hand.surfaces[1].geoms) == 2
        assert hand.welded["l_tip"].link == "l_2"

    def test_slides_have_nothing_of_the_models_defaults(self, made):
        joint = '<joint limited="true" armature="5" frictionloss="9" stiffness="7"/>'
        default = f'<default><default class="g">{joint}</default></default><worldbody>'
        model = MODEL.replace("<worldbody>", default)
        hand = hands.get(made(model.replace('name="palm"', 'name="palm" childclass="g"')))
        slide = hand.build().compile().joint("slide_x")
        assert [*slide.limited, *slide.armature, *slide.frictionloss, *slide.stiffness] == [0] * 4

    def test_what_a_model_says_about_the_world_is_left_out(self, made):
        world = (
            '<option gravity="0 0 9" density="9" wind="1 0 0" >'
            '<flag gravity="disable" contact="disable"/></option>'
            '<size memory="20K"/><equality><weld body1="palm"/></equality>'
        )
        usual, changed = (
            GraspEnv(path, setup(path, layout="5")).simulator.model
            for path in (made(), made(with_more(world), name="tied.xml"))
        )
        for name in ("gravity", "density", "wind", "disableflags", "enableflags"):
            assert np.all(getattr(changed.opt, name) == getattr(usual.opt, name)), name
        assert (changed.body_mass == usual.body_mass).all()
        assert (changed.neq, changed.nu, changed.narena) == (usual.neq, usual.nu, usual.narena)

    def test_a_palmar_side_follows_from_what_moves_the_link(self, made):
        hand = hands.get(made(toml=FOLLOWERS))  # nothing in [closed] bends the last links
        assert hand.surfaces[1].palmar == pytest.approx(hand.surfaces[0].palmar)
        model = MODEL
        for n, s in (("l", -1), ("r", 1)):
            turns = f'name="{n}_a" axis="0 {s} 0" range="0 1.5"'
            model = model.replace(turns, f'name="{n}_a" type="slide" axis="0 0 {-s}" range="0 0.03"')
        hand = hands.get(made(model, FOLLOWERS.replace("0.6", "0.02")))
        assert np.allclose(hand.surfaces[0].palmar, (0, 0, 1), atol=1e-4)  # the left slides towards it

    def test_a_narrow_link_does_not_set_the_pitch_of_others(self, made):
        hand = hands.get(made(MODEL.replace('size="0.008" fromto', 'size="0.002" fromto', 1)))
        assert [*hand.pitch.columns.values()] == pytest.approx([0.0012, 0.0048, 0.0048, 0.0048])

    def test_a_range_may_be_given(self, made):
        path = made(UNLIMITED, TOML.replace("[closed]", "[ranges]\nl_a = [0, 1]\n[closed]"))
        assert hands.get(path).action_map.centre[3] == 0.5
        hand = hands.get(made(UNLIMITED))
        assert hand.action_map.half_range[3] == 1.57
        assert hand.notes[0].endswith("gives them another: l_a")

    @pytest.mark.parametrize(("model", "toml", "complaint"), NO_HANDS)
    def test_what_is_no_hand_is_refused_by_name(self, made, model, toml, complaint):
        with pytest.raises(ValueError, match=complaint):
            hands.get(made(model, toml))


LINK = """<link name="{n}">
<inertial><mass value="0.02"/>
<inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><mesh filename="no.dae"/></geometry></visual>
<collision><origin xyz="0.025 0 0" rpy="0 1.5708 0"/><geometry>{shape}</geometry></collision></link>"""
JOINT = """<joint name="{n}_{j}" type="{kind}"><parent link="{up}"/><child link="{n}_{down}"/>
<origin xyz="{xyz}" rpy="0 {turn} 0"/><axis xyz="0 {s} 0"/>
<limit lower="0" upper="1.5" effort="1" velocity="1"/>{mimic}</joint>"""
FIXED = '<joint name="f" type="fixed"><parent link="base"/><child link="palm"/></joint>'


def urdf(shape='<cylinder radius="0.008" length="0.05"/>', mimic="", kind="revolute"):
    base = LINK.format(n="palm", shape='<box size="0.12 0.06 0.03"/>').replace('rpy="0 1.5708 0"', "")
    parts = ['<link name="base"/>', FIXED]
    for n, s in (("l", -1), ("r", 1)):
        first = {"up": "palm", "xyz": f"{0.05 * s} 0 -0.02", "turn": 1.5708}
        parts += [LINK.format(n=f"{n}_{k}", shape=shape) for k in (1, 2)]
        parts.append(JOINT.format(n=n, j="a", kind="revolute", down=1, s=s, mimic="", **first))
        more = {"up": f"{n}_1", "xyz": "0.05 0 0", "turn": 0, "mimic": mimic.format(n=n)}
        parts.append(JOINT.format(n=n, j="b", kind=kind, down=2, s=s, **more))
    return f'<robot name="t">{base.replace("0.025 0 0", "0 0 0")}{"".join(parts)}</robot>'


URDF = TOML.replace("0.038", "0.05")
XACRO = 'xmlns:xacro="http://ros.org/wiki/xacro"'


class TestUrdf:
    @pytest.mark.parametrize("place", ["package://toy/meshes/bone.obj", "meshes/bone.obj", "bone.obj"])
    def test_meshes_are_found(self, made, tmp_path, place):
        """In the folder of the package that the URDF is in, beside it, or under its meshdir."""
        path = made(urdf(f'<mesh filename="{place}"/>'), URDF, "hand.urdf")
        folder = tmp_path / Path(place.removeprefix("package://toy/")).parent
        folder.mkdir(exist_ok=True)
        corners = [(x, y, z) for x in (-8, 8) for y in (-8, 8) for z in (-25, 25)]
        lines = [f"v {x / 1e3} {y / 1e3} {z / 1e3}" for x, y, z in corners]
        lines += ["f 1 2 4", "f 1 4 3", "f 5 7 8", "f 5 8 6", "f 1 5 6", "f 1 6 2"]
        lines += ["f 3 4 8", "f 3 8 7", "f 1 3 7", "f 1 7 5", "f 2 6 8", "f 2 8 4"]
        (folder / "bone.obj").write_text("\n".join(lines) + "\n")
        hand = hands.get(path)
        assert hand.surfaces[0].geoms[0].kind == "mesh"
        assert folder / "bone.obj" in hand.paths
        in_mm = urdf(f'<mesh filename="{place}" scale="1e3 1e3 1e3"/>')
        with pytest.raises(ValueError, match=r"found mesh .* m large: its file is in mm; say scale="):
            hands.get(made(in_mm, URDF, "hand.urdf"))

    @pytest.mark.parametrize(
        ("model", "complaint"),
        [
            (urdf('<mesh filename="a/bone.dae"/>'), "collision mesh a/bone.dae, allowed STL and OBJ"),
            (urdf('<mesh filename="package://no/bone.stl"/>'), "found no file for mesh package://no"),
            (urdf()[:-9], "model: .*no element found|model: unclosed token"),
            (f"<robot {XACRO}><xacro:macro/></robot>", "found xacro, which ROS expands: xacro FILE"),
        ],
    )
    def test_what_is_missing_is_said(self, made, model, complaint):
        with pytest.raises(ValueError, match=complaint):
            hands.get(made(model, URDF, "hand.urdf"))

    def test_inertias_may_be_rounded_to_zero_and_joints_continuous(self, made):
        model = urdf(kind="continuous").replace('izz="1e-5"', 'izz="0"')
        hand = hands.get(made(model, URDF, "hand.urdf"))
        assert hand.notes[0].endswith("gives them another: l_b, r_b")

    def test_a_mimic_has_its_offset(self, made):
        mimic = '<mimic joint="{n}_a" multiplier="0.5" offset="0.7"/>'
        hand = hands.get(made(urdf(mimic=mimic), FOLLOWERS.replace("0.038", "0.05"), "hand.urdf"))
        assert hand.couplings[0] == ("l_b", "l_a", 0.5, 0.7, True)
        assert hand.palm == "base"  # of which the link called palm is a part

    def test_nothing_is_printed(self, made, capfd, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        path = made(urdf(), URDF, "hand.urdf")
        model_file.compiled(hands.get(path).build())
        assert capfd.readouterr() == ("", "")
        assert not Path("MUJOCO_LOG.TXT").exists()


class TestSensors:
    """`--layout model`: what a model has of its own."""

    @pytest.mark.parametrize("named", ['name="{n}_pad" ', ""])
    def test_sites_of_touch_sensors(self, made, named):
        site = '<site name="{n}_s" pos="0 0 0.008" size="0.003"/>'
        pad = f'<body {named}pos="0.02 0 0">{site}</body>'
        model = with_more('<sensor><touch site="l_s"/><touch site="r_s"/></sensor>')
        hand = hands.get(made(model.replace(FINGERS, fingers(pad + TIP))))
        taxels = layouts.load("model").place(hand)
        assert taxels.names == ("l_s", "r_s")
        assert taxels.links == ("l_2", "r_2")
        np.testing.assert_allclose(taxels.positions, [[0.02, 0, 0.008]] * 2, atol=1e-6)
        np.testing.assert_allclose(taxels.normals, [[0, 0, 1]] * 2, atol=1e-3)
        assert taxels.radii.tolist() == [0.003] * 2

    def test_links_of_a_urdf_that_are_called_sensors(self, made):
        pads = "".join(
            f'<link name="{n}_sensor_1"/><joint name="{n}_s" type="fixed"><parent link="{n}_2"/>'
            f'<child link="{n}_sensor_1"/><origin xyz="0.02 0 0.008"/></joint>'
            for n in "lr"
        )

        def found(pads):
            model = urdf().replace("</robot>", f"{pads}</robot>")
            return hands.get(made(model, URDF, "hand.urdf"))

        taxels = layouts.load("model").place(found(pads))
        assert taxels.names == ("l_sensor_1", "r_sensor_1")
        assert layouts.load("model").place(found(pads.replace("sensor", "fsr"))).names[0] == "l_fsr_1"
        box = '<collision><geometry><box size="0.01 0.01 0.001"/></geometry></collision></link>'
        shaped = found(pads.replace('_sensor_1"/><joint', f'_sensor_1">{box}<joint'))
        np.testing.assert_allclose(shaped.sensors.points[0].normal, taxels.normals[0], atol=1e-3)
        hand = found(pads.replace("0.008", "0.02", 1))
        assert str(hand.sensors) == "left out, as they are not on the skin: l_sensor_1"
        hand = found(pads.replace("0.008", "0.02"))
        with pytest.raises(ValueError, match=r"no taxel .*: left out, .*: l_sensor_1, r_s"):
            layouts.load("model").place(hand)
        with pytest.raises(ValueError, match=r"no taxel .*: looked for sites with MuJoCo's <touch>"):
            layouts.load("model").place(found(""))

    def test_the_contact_rule_feels_what_a_welded_part_touches(self, made, tmp_path, simulator):
        """On the part by its name, and on the link that it is part of; a site may have any name."""
        site = on_palm('<site name="sensor0"/>')  # as MuJoCo's own sensors have
        model = site.replace(FINGERS, fingers(f'<body name="{{n}}_pad">{TIP}</body>'))
        path, layout = made(model), tmp_path / "own.toml"
        places = (("l_pad", [0.02, 0, 0.008]), ("r_2", [0.02, 0, -0.008]), ("l_1", [0, 0, 0.008]))
        row = '[[taxel]]\nlink = "{}"\nposition = {}\nradius = 0.015\n'
        layout.write_text("".join(row.format(*place) for place in places))
        env = made_env(path, simulator, layout=str(layout), touch_rule="contact")
        assert env.taxel_readings().tolist() == [0, 0, 0]
        for targets in grasp(env):
            env.step_to(targets)
        assert env.taxel_readings().tolist() == [1, 1, 0]


def test_thresholds_grow_with_the_hand(made):
    """An object that long fingers still hold has not fallen."""
    model = MODEL.replace('0.05 0 0"', '0.15 0 0"').replace("0.03 0 0", "0.13 0 0")
    path = made(model, TOML.replace("0.038", "0.138").replace("0.6", "0.3"))
    assert hands.get(path).reach == pytest.approx(math.hypot(0.29, 0.05), abs=0.02)
    assert hands.get("shadow").reach == 0.15
    env = GraspEnv(path, setup(path, task="handover", layout="5"))
    assert env.task.fallen > 0.3
    assert env.task.hold.out_of_reach > 0.3
